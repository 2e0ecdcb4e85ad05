"""Socket options of the link: no delay, and dead peers detected by the kernel."""

import socket

_IDLE_S, _INTERVAL_S, _PROBES = 1, 1, 3  # [ours] a peer that vanished is detected within 4 s


def prepare(sock: socket.socket) -> None:
    """Set a socket to send without delay, to probe an idle peer, and to give up one that acknowledges nothing.

    This detects a lost peer within seconds; faster detection needs a heartbeat.
    """
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", _IDLE_S),
        ("TCP_KEEPALIVE", _IDLE_S),  # its name on macOS
        ("TCP_KEEPINTVL", _INTERVAL_S),
        ("TCP_KEEPCNT", _PROBES),
        ("TCP_USER_TIMEOUT", 1000 * (_IDLE_S + _INTERVAL_S * _PROBES)),  # Linux
    ):
        option = getattr(socket, name, None)
        if option is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)
