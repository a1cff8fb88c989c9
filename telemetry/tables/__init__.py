"""Tables that others wrote, read as recordings: CSV of every dialect, Parquet, Arrow and Feather, and those of
telemetry.formats.

The files, in the order in which a table passes them: text and arrow_columns (a file -> the table as it is, raw), wanted
and mapping (what a model needs, and what the user says), several_clocks (one column of time), times (which one, and its
unit), matched (columns -> channels), stamps (what is wrong with the clock), several_rates (rows that channels share),
read (all of it).

Whatever is assumed is a sentence in `Recording.assumed`. What only physics can show, like an angle in degrees, is asked
in estimators.readings, and tried with assumed.
"""
