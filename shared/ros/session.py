"""The Zenoh session with which a service takes part in ROS 2."""

from __future__ import annotations

from typing import TYPE_CHECKING

from saccade.shared.config import RosConfig
from saccade.shared.errors import SaccadeError

if TYPE_CHECKING:
    import zenoh

ROUTER_S = 5.0


def open_ros(ros: RosConfig) -> zenoh.Session:
    """Connects to the router of ROS 2. Raises SaccadeError if it does not answer."""
    from saccade.shared.bus.session import open_session

    try:
        return open_session(ros.router, listen=False, onlooker=False, timeout_s=ROUTER_S)
    except SaccadeError as error:
        raise SaccadeError(f"ros.router: {str(error).removeprefix('bus ')}; `ros2 run rmw_zenoh_cpp rmw_zenohd` "
                           "starts the router of ROS 2") from error
