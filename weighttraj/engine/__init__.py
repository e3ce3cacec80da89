"""Where tasks are done: in this process, in several, or on a Dask cluster.

A task is idempotent: done again after its worker was killed, it goes on from what is on disk. So
who does it does not move a bit of the result.
"""

from weighttraj.engine.base import Engine, Outcome, Serial, Tell
from weighttraj.engine.choose import engine_of
from weighttraj.engine.processes import Processes

__all__ = ["Engine", "Outcome", "Processes", "Serial", "Tell", "engine_of"]
