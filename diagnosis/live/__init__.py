"""The diagnosis while the vehicle runs: live scores every effect along with the recursion, products stores each second
of it, onset and odds give the likelihood of each effect by onset, line follows a frequency, naming gives names."""
