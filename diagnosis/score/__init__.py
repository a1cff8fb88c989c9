"""What a little of each effect would do: whitened has the innovations and all their derivatives, score_test the size
and the p-value of every effect from these, change_points the instants at which something may have set in."""
