"""A model against records, without a name for what it lacks: ahead and horizons predict some time ahead, closed_loop
and closed_loop_error go on alone, compare holds several models against one record; limit is the best that any could do,
and relevance says what share of these errors an effect makes."""
