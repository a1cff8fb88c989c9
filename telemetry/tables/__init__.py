"""Tables that others wrote, read as recordings: CSV of every dialect, Parquet, Arrow and Feather.

The files, in the order in which a table passes them: decoded (bytes -> text), split (text -> rows of fields), head
(names, units, first row of data), fields (text -> numbers), raw (the table as it is in the file), csv_text and
arrow_columns (a file -> raw), wanted and mapping (what the reader needs, and what its user says), times (the column of
time), clock (what is wrong with it), matched (columns -> channels), several_rates, read (all of it).

Whatever is assumed is a sentence in `Recording.assumed`. What only physics can show, like an angle in degrees, is asked
in estimators.readings.
"""
