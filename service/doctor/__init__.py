"""The computer's health, and what is sent to somebody who helps.

`facts` says what is asked, `collect` asks the computer, `checks` judges (pure). `secrets` finds passwords and tokens,
and `bundle` packs everything but them into one archive.
"""
