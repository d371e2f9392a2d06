"""One body over many processes: MPI starts and controls them; MPI and NCCL exchange their data.

``mpirun -n 4 python script.py`` runs the script on four ranks. ``Simulation`` has the names of
``warp_corot.Simulation`` and is called on every rank.
"""

from . import mpi
from .growth import from_domain
from .meshes import box, divided, load
from .part import gather
from .recording import record
from .simulation import Simulation
from .sweeps import sweep

__all__ = ["Simulation", "box", "divided", "from_domain", "gather", "load", "record", "sweep"]

mpi.choose_device()
