"""Environments."""
from .lift import Lift
from .palpate import Palpate
from .reach import Reach
from .retract import Retract
from .thread import Thread
