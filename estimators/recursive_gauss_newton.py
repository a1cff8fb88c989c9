"""Least squares in recursive form on a model that is linear only near by: what a recursive prediction error method needs.

A chunk of residuals r with derivatives J (of the prediction) at the common unknowns z says r + J z = J z* + noise for the
true z*. These equations are gathered in information form, discounted with age, and solved together with the prior,

    information = sum of w J'J,   right = sum of w J'(r + J z),   z = (information + prior)^-1 right,

which is the Gauss-Newton recursion of Ljung, "System identification", 2nd ed., (11.44) to (11.47); the prior, being no
data, is never forgotten, so the covariance is bounded where nothing is excited. z counts from the prior's centre in
units of its typical size. Each stretch of data has unknowns of its own, its initial state, which are eliminated when the
stretch ends.

The first chunks are seen from a start value that may be far off, and their derivatives are wrong by as much: what is
gathered is also discounted with every move of z.
"""
