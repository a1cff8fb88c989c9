"""The benchmark of hidden effects: how often what a virtual vehicle has and the model lacks is called by its name.

`cases` says what is asked, `trial` asks it, `spread` runs it on many cores or machines. methods/ are what is asked: the
diagnosis, and the baselines that it is compared with. results/ keep the trials and count them.
"""
