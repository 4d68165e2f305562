"""Matrix arithmetic with the same bits on every machine, compilation of functions, and a disc cache of arrays."""
