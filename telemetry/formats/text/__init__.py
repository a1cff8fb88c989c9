"""Tables as text, in the order in which a file passes them: decoded (bytes -> text), split (lines -> fields), head
(names, units, first row of data), fields (text -> numbers), text_file (all of it, as a raw table).
"""
