"""Files of every program as raw tables, one for each topic: what telemetry.tables makes recordings of.

files (which format a file is, and who reads it), topics (messages -> tables), then one module for each format, and a
package for text: CSV in all its dialects. Those that need a package of others are extras of upright, imported only when
such a file is read.
"""
