"""The control process: the daemon answers commands over its api and runs the loop, which goes through the sequence of
an experiment with its excitation, and asks safety each cycle; assembly makes its parts from the vehicle file."""
