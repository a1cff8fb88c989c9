"""The control process. The daemon answers commands over its api and runs the loop. The loop steps through the sequence
of an experiment with its excitation, and checks safety each cycle. assembly builds the parts from the vehicle file."""
