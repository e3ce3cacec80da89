"""Data sets that are somewhere else: addresses, and the objects at them.

``address`` says where, ``store`` reads and writes objects, ``hub`` knows the Hugging Face hub.
"""

from weighttraj.remote.address import Place, RemotePath, here, is_remote

__all__ = ["Place", "RemotePath", "here", "is_remote"]
