"""OpenIGTLink over TCP: several clients, bounded queues, detection of lost peers. It does not interpret messages."""

from sightline.robot.transport.client import BlockingClient, Client
from sightline.robot.transport.connection import LOOPBACK, PORT, Connection, Handler, Server, serve

__all__ = ["LOOPBACK", "PORT", "BlockingClient", "Client", "Connection", "Handler", "Server", "serve"]
