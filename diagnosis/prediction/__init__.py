"""A model against records, whatever it lacks: ahead and horizons predict some time ahead, closed_loop and
closed_loop_error simulate the closed loop, compare compares several models with one record; limit gives the best
possible prediction, relevance the share of these errors that an effect accounts for."""
