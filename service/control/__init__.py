"""The control process. The daemon opens the buses and sets up the drives, runs the cycle (cycle/) and answers requests
(clients/). assembly builds the parts from the vehicle file; what was commissioned and adopted is kept on the disk."""
