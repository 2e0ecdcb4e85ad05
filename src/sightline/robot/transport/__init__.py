"""OpenIGTLink over TCP: several clients, bounded queues, detection of lost peers. It does not interpret messages.

`ros2`, imported where it is used, publishes by ROS 2.
"""

from sightline.robot.transport.client import BlockingClient, Client
from sightline.robot.transport.connection import LOOPBACK, PORT, Connection, Handler, Server, serve

__all__ = ["LOOPBACK", "PORT", "BlockingClient", "Client", "Connection", "Handler", "Server", "serve"]
