"""The evaluations that a step may name: table lists them."""
