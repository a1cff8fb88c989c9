"""The recordings of a fleet: one diagnosis each (examine), over processes or machines (run), into one file (results),
and what changed over time on a page (trends, report). The files may be in a folder or an object store (store)."""
