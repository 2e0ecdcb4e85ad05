"""How every socket of the link is set: no delay, and a dead peer noticed by the kernel."""

import socket

_IDLE_S, _INTERVAL_S, _PROBES = 1, 1, 3  # [ours] a peer that vanished without a word is noticed within 4 s


def prepare(sock: socket.socket) -> None:
    """Send at once; probe a peer that says nothing; give up one that acknowledges nothing.

    These are seconds: what must be noticed in fractions of one needs a heartbeat.
    """
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", _IDLE_S),
        ("TCP_KEEPALIVE", _IDLE_S),  # what macOS calls it
        ("TCP_KEEPINTVL", _INTERVAL_S),
        ("TCP_KEEPCNT", _PROBES),
        ("TCP_USER_TIMEOUT", 1000 * (_IDLE_S + _INTERVAL_S * _PROBES)),  # Linux
    ):
        option = getattr(socket, name, None)
        if option is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)
