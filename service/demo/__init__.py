"""`upright demo`: run executes the demo on a virtual bus, figure draws its recordings."""
