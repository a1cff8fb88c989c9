"""What is written to the disk: a recording of the cycles, and beside it the raw CAN frames, by a process of its own."""
