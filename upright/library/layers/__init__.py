"""What the package takes from the layers below, and nothing else: each module imports names for the others to use.

So this folder and `upright.__main__` are the only places that know where these layers are. Its modules differ by what
they cost: effects need little more than numpy, recordings what reads, results all that fits, pictures matplotlib.
"""
