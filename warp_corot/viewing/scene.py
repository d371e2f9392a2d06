"""A session's frames as viser's scene: surfaces, colours, arrows, and the mouse."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import Shape, Sphere
from warp_corot.contact.tool import Tool
from warp_corot.io.pictures.colors import TISSUE

from .frames import Frame
from .glb import colored_mesh
from .rigid import mesh_of

if TYPE_CHECKING:
    from viser import ViserServer

    from .session import Session

#: Length of the scene's longest side: viser's cameras and lights suit bodies of about this size.
EXTENT = 2.0
_TISSUE = tuple(round(255 * c) for c in TISSUE)
_OBSTACLE = (150, 155, 165)
_ARROW = (20, 90, 200)


class _Body:
    """The nodes of one body's surface in the scene.

    A plain mesh follows the mouse. With colours it is transparent, and two coloured meshes take turns: the hidden one
    receives the new frame while the other is shown, because browsers take a moment to read it.
    """

    def __init__(self, server: ViserServer, name: str, on_drag: Callable[[Any], Any]):
        self._server, self._name, self._on_drag = server, name, on_drag
        self._plain: Any = None
        self._turns: list[Any] = [None, None]
        self._seen, self._number = 0, -1

    def show(
        self,
        number: int,
        points: npt.NDArray[np.float32],
        triangles: npt.NDArray[np.int32],
        colors: npt.NDArray[np.uint8] | None,
    ) -> None:
        if number != self._number or self._plain is None:
            self._number = number
            # Without shadows, which cost browsers more than all the rest, and fall on meshes in the same place.
            self._plain = self._server.scene.add_mesh_simple(
                self._name,
                points,
                triangles,
                color=_TISSUE,
                side="double",
                opacity=None if colors is None else 0.0,
                cast_shadow=False,
                receive_shadow=False,
            )
            self._plain.on_drag(self._on_drag)
            for turn in self._turns:
                if turn is not None:
                    turn.remove()
            self._turns = [None, None]
        else:
            self._plain.vertices = points
        opacity = None if colors is None else 0.0
        if self._plain.opacity != opacity:
            self._plain.opacity = opacity
        if colors is None:
            for turn in self._turns:
                if turn is not None:
                    turn.visible = False
            return
        self._show_colors(colored_mesh(points, triangles, colors))

    def _show_colors(self, glb: bytes) -> None:
        hidden = 1 - self._seen
        if self._turns[hidden] is None:
            self._turns[hidden] = self._server.scene.add_glb(
                f"{self._name}-colors{hidden}", glb, visible=False, cast_shadow=False, receive_shadow=False
            )
        else:
            self._turns[hidden].glb_data = glb
        other = self._turns[self._seen]
        if other is not None:
            # The browser has read the last frame by now.
            other.visible = True
            self._turns[hidden].visible = False
        self._seen = hidden


class Scene:
    """The scene of a page.

    Args:
        server: viser's server.
        session: The session that is shown; only its commands are called, on the session's own thread.
    """

    def __init__(self, server: ViserServer, session: Session):
        self._server, self._session = server, session
        low, high = session.bounds
        self._middle, self._scale = 0.5 * (low + high), EXTENT / session.size
        self._bodies = [
            _Body(server, f"/body{k}", self._dragging(self._holding(k))) for k in range(len(session.sim.bodies))
        ]
        self._obstacles = [self._obstacle(k, tool.shape) for k, tool in enumerate(session.tools)]
        self._arrows = server.scene.add_arrows(
            "/hands",
            np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1e-4]]]),
            _ARROW,
            shaft_radius=0.012,
            head_radius=0.035,
            head_length=0.08,
            visible=False,
        )
        up = session.sim.bodies[0].mesh.up_axis
        server.scene.set_up_direction("+y" if up == "Y" else "+z")
        towards = 0.85 * np.array([1.6, 0.9, 2.4] if up == "Y" else [1.6, -2.4, 0.9])
        server.initial_camera.position = tuple(towards)
        server.initial_camera.look_at = (0.0, 0.0, 0.0)

    def show(self, frame: Frame, colored: bool) -> None:
        """Send a frame to all visitors."""
        with self._server.atomic():
            for k, body in enumerate(self._bodies):
                points = self._placed(frame.positions[k])
                body.show(frame.number, points, frame.triangles[k], frame.colors[k] if colored else None)
            self._show_arrows(frame)
            for obstacle, pose in zip(self._obstacles, frame.poses, strict=True):
                if obstacle is not None:
                    obstacle.position = self._placed(pose[:3])
                    obstacle.wxyz = pose[[6, 3, 4, 5]]

    def _show_arrows(self, frame: Frame) -> None:
        if frame.ends:
            points = self._placed(np.array(list(frame.ends.values())))
            # An arrow without length has no direction.
            points[:, 1] += 1e-4
            self._arrows.points = points
        if self._arrows.visible != bool(frame.ends):
            self._arrows.visible = bool(frame.ends)

    def _obstacle(self, number: int, shape: Shape) -> Any:
        """The node of an obstacle; None for an obstacle that cannot be drawn."""
        mesh = mesh_of(shape, self._session.size)
        if mesh is None:
            return None
        node = self._server.scene.add_mesh_simple(
            f"/obstacle{number}",
            self._scale * mesh.vertices,
            mesh.faces,
            color=_OBSTACLE,
            flat_shading=not isinstance(shape, Sphere),
            cast_shadow=False,
            receive_shadow=False,
        )
        session = self._session
        if isinstance(session.sim.obstacles[number], Tool):
            node.on_drag(self._dragging(lambda owner, _: session.press_tool(owner, number)))
        return node

    def _placed(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """Positions [m] in the scene."""
        return ((points - self._middle) * self._scale).astype(np.float32)

    def _holding(self, body: int) -> Callable[[Any, Any], None]:
        return lambda owner, position: self._session.press(owner, body, position)

    def _dragging(self, press: Callable[[Any, Any], None]) -> Callable[[Any], Any]:
        """The function that is called while the mouse drags something: in order, and without waiting.

        Args:
            press: Called with the visitor and the place that was pressed [m].
        """

        # An event's own start moves with the tool that is dragged.
        starts: dict[Any, npt.NDArray[np.float64]] = {}

        async def dragged(event: Any) -> None:
            session, owner = self._session, event.client_id
            begun, end = (np.asarray(p, dtype=np.float64) for p in (event.start_position, event.end_position))
            if event.phase == "start":
                starts[owner] = begun
                position = begun / self._scale + self._middle
                session.ask(lambda: press(owner, position))
            start = starts.get(owner, begun)
            if event.phase == "end":
                starts.pop(owner, None)
                session.ask(lambda: session.let_go(owner))
            else:
                session.ask(lambda: session.move(owner, (end - start) / self._scale))

        return dragged
