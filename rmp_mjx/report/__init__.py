"""Compare training runs on one page: `python -m rmp_mjx.report RUN...`.

Needs the extra `train`. Runs that differ in their seed only form a group. The page
needs no other file. It has learning curves with 95 % intervals over the seeds, safety
figures, a table, and the options in which the groups differ.
"""
