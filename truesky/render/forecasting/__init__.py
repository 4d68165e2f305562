"""What a request will cost before anything of it is made: rows, seconds, bytes, and how fast this machine is."""
