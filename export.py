"""Export a policy with its controller: `python export.py RUN --out arm.rmp`."""

import sys

from envs.export import main

if __name__ == "__main__":
    sys.exit(main())
