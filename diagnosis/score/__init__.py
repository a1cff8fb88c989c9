"""The response of the innovations to a small amount of each effect: whitened has the innovations and all their
derivatives, score_test the amplitude and the p-value of every effect from these, change_points the times at which
something may have set in."""
