"""Evaluate a policy: `python eval.py --run RUN --obstacles 2 --layout close`."""

import sys

from envs.eval import main

if __name__ == "__main__":
    sys.exit(main())
