"""One printed part in each file: a function of the dimensions, and which way is up on the printer."""
