"""The diagnosis while the vehicle runs: live scores every effect along with the recursion, products keep a second of
it, onset and odds say since when each is how likely, line follows a frequency, naming gives names."""
