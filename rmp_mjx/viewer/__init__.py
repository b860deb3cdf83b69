"""A page in the browser that shows what the tree thinks: `python -m rmp_mjx.viewer`.

Needs the extra `viewer`. `session` simulates the arm, `page` draws it and takes orders.
"""
