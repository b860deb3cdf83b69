"""Batched manipulation tasks. `load` makes one by name."""

from .base import ArmEnv as ArmEnv
from .options import Options as Options
from .scene import Contacts as Contacts
from .task import Mark as Mark
from .task import View as View
from .types import Entry as Entry
from .types import Score as Score
from .types import State as State

# isort: split
# After the module `task`, whose name the function takes.
from .registry import ENVS as ENVS
from .registry import describe as describe
from .registry import load as load
from .registry import make as make
from .registry import make_options as make_options
from .registry import names as names
from .registry import task as task
