from . import locomotion as locomotion
from . import pictures as pictures
from .locomotion import Locomotion as Locomotion
from .locomotion import Task as Task
from .registry import make as make
from .registry import names as names
