"""What the package takes from the layers below, and nothing else: each module imports names for the others to use.

So this folder and `upright.__main__` are the only places that know where these layers are. The modules differ by what
they cost: effects 0.1 s, recordings what SciPy needs, results all that fits and draws.
"""
