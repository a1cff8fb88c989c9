"""How a table is to be read, where only physics can tell: seconds or milliseconds, radians or degrees, which sign,
which channel.

readings (what else a table may mean), score (how much better than extrapolation a model predicts it, read so), question
(the reading that fits beyond doubt, if it is not the plain one). Nothing is changed here: a question names the option
with which its user changes it.
"""
