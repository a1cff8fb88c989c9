"""`upright demo`: story is what is told, run tells it on a virtual bus, figure draws it."""
