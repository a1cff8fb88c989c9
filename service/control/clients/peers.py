"""Who is at the other end of a Unix socket: the kernel knows it, and the client cannot choose it (SO_PEERCRED).

The mode of the control socket lets only its owner and its group connect. The credentials are checked all the same: the
mode can be changed by anybody who administers the machine, and a descriptor can be handed on.
"""

from __future__ import annotations

import os
import pwd
import socket
import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from upright.telemetry.errors import UprightError

_CREDENTIALS = struct.Struct("3i")
_PEER_GROUPS = 59
"""SO_PEERGROUPS of Linux, which Python does not name."""
_MOST_GROUPS = 256


class FolderError(UprightError):
    """A folder that is to be the user's own belongs to somebody else."""


@dataclass(frozen=True, slots=True)
class Peer:
    """The process that has connected, with its effective user and groups at that time."""

    process: int
    user: int
    groups: frozenset[int]

    @property
    def name(self) -> str:
        """The user's name, or the number if it is not known."""
        return names().get(self.user, str(self.user))

    def may_use(self, owner: int, group: int) -> bool:
        """Whether this is the owner of the socket, one of its group, or root."""
        return self.user in (0, owner) or group in self.groups


@cache
def names() -> dict[int, str]:
    """The users that are known when it is first called: a directory of users on the network may take long to answer."""
    return {each.pw_uid: each.pw_name for each in pwd.getpwall()}


def peer_of(connection: socket.socket) -> Peer:
    """The peer of a connected Unix socket."""
    process, user, group = _CREDENTIALS.unpack(
        connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    )
    try:
        further = connection.getsockopt(socket.SOL_SOCKET, _PEER_GROUPS, 4 * _MOST_GROUPS)
    except OSError:  # an older kernel, or somebody in more groups
        further = b""
    return Peer(process, user, frozenset({group, *struct.unpack(f"{len(further) // 4}I", further)}))


def check_own(folder: Path) -> None:
    """Raises FolderError unless `folder` is a real folder of this user, which others cannot write.

    For a folder of a known name in a place where everybody can make one.
    """
    there = folder.lstat()
    if not folder.is_dir() or folder.is_symlink() or there.st_uid != os.geteuid() or there.st_mode & 0o022:
        raise FolderError(
            f"{folder} was made by somebody else, or others can write it.",
            remedy="Have it removed, or give another socket with --socket PATH.",
        )
