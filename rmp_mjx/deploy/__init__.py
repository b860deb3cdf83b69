"""A trained policy with its controller on a robot; needs JAX and NumPy alone."""

from rmp_mjx.deploy.artefact import DeployError as DeployError
from rmp_mjx.deploy.backends import Backend as Backend
from rmp_mjx.deploy.backends import CallbackBackend as CallbackBackend
from rmp_mjx.deploy.backends import Pace as Pace
from rmp_mjx.deploy.deployed import Deployed as Deployed
from rmp_mjx.deploy.deployed import Limits as Limits
from rmp_mjx.deploy.deployed import load as load
from rmp_mjx.deploy.loop import Loop as Loop
from rmp_mjx.deploy.loop import Report as Report
from rmp_mjx.deploy.numpy_policy import NumpyPolicy as NumpyPolicy
from rmp_mjx.deploy.objects import Objects as Objects
from rmp_mjx.deploy.priority import hurry as hurry
from rmp_mjx.deploy.priority import relax as relax
from rmp_mjx.deploy.sources import ObstacleSource as ObstacleSource
from rmp_mjx.deploy.targets import PolicyTargets as PolicyTargets
from rmp_mjx.deploy.targets import ReachTargets as ReachTargets
from rmp_mjx.deploy.targets import Targets as Targets
from rmp_mjx.deploy.targets import Task as Task
from rmp_mjx.deploy.targets import ViaPoints as ViaPoints
from rmp_mjx.deploy.watchdog import Watchdog as Watchdog
