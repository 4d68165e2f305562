"""Effects of charge transfer, amplifiers and analogue-to-digital converters."""
