"""The control cycle: what happens to a sample (`loop`), what is asked of the vehicle (`operation`), the experiment that
runs (`sequence`), and what may end it (`safety`)."""
