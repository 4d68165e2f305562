"""Effects of the readout: charge transfer to the amplifiers, the amplifiers, and analogue-to-digital conversion."""
