from .config import Config as Config
from .config import Hyperparameters as Hyperparameters
from .host.environments import make_env as make_env
from .host.fitting import FitProgress as FitProgress
from .host.fitting import FitResult as FitResult
from .host.fitting import fit as fit
from .host.members import member as member
from .imitation import agents as agents
from .policy import load_policy as load_policy
from .presets import preset as preset
from .train import TrainState as TrainState
from .train import init as init
from .train import iterate as iterate
from .train import make_train as make_train

__version__: str
