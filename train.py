"""Train a policy: `python train.py --env trajectory --controller rmp_vices`."""

import sys

from envs.train import main

if __name__ == "__main__":
    sys.exit(main())
