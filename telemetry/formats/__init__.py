"""Files of every program as raw tables, one for each topic: what telemetry.tables makes recordings of.

files (which format a file is, and who reads it), topics (messages -> tables), then one module for each format. Those
that need a package are extras of upright, imported only when such a file is read.
"""
