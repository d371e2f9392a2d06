"""Draws newton.png: the examples for Newton in Newton's own GL viewer, soft bodies coloured by von Mises stress.

PYGLET_HEADLESS=1 python docs/images/draw_newton.py newton.png: a minute or two, with pyglet and matplotlib.
"""

import runpy
import sys
from pathlib import Path

import newton
import newton.examples
import numpy as np
import warp as wp
from matplotlib.figure import Figure

import warp_corot.newton as wn
from warp_corot.io.pictures.colors import VertexAverage, round_limit, stress_colors

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "newton"
WIDTH, HEIGHT, FINER = 400, 300, 3
#: Example, frame, the camera's position [m], its pitch and yaw [deg], and the title.
PANELS = (
    ("hanging", 26, (2.9, -1.0, 1.6), -10.0, 137.0, "cantilevers after 0.43 s"),
    ("drop", 15, (0.92, -0.75, 0.56), -15.5, 140.5, "a soft ball falls on a rigid box"),
    ("gripper", 95, (0.15, -0.46, 0.32), -8.0, 108.0, "two fingers hold up a soft block"),
)


def with_stress(finalize):
    """Let models' states carry stress, even if the example does not ask for it."""

    def finalize_with_stress(builder, **options):
        wn.register_custom_attributes(builder)
        return finalize(builder, **options)

    return finalize_with_stress


def surface_of(example):
    """Drawn points, their triangles, and von Mises stress there [Pa]."""
    model, state = example.model, example.state_0
    tets, x = model.tet_indices.numpy().reshape(-1, 4), state.particle_q.numpy()
    volumes = np.abs(1.0 / np.linalg.det(model.tet_poses.numpy()))
    stress = VertexAverage(tets, volumes, len(x))(state.warp_corot.von_mises.numpy())
    skins = model.deformable_visual_meshes
    if not skins:
        return x, model.tri_indices.numpy().ravel(), stress
    parents, weights = skins[0].parent.numpy(), skins[0].weights.numpy()
    at = [np.einsum("vi,vi...->v...", weights, nodal[tets[parents]]) for nodal in (x, stress)]
    return at[0].astype(np.float32), skins[0].indices.numpy(), at[1]


def draw(name, frame, place, pitch, yaw):
    """The picture uint8 [h, w, 3], and the stress of the darkest colour [Pa]."""
    viewer = newton.viewer.ViewerGL(width=WIDTH * FINER, height=HEIGHT * FINER, headless=True)
    made = runpy.run_path(str(FOLDER / f"{name}.py"), run_name="example")["Example"]
    example = made(viewer, newton.examples.default_args())
    for _ in range(frame):
        example.step()
    example.solver.check()
    points, triangles, stress = surface_of(example)
    limit = round_limit(float(np.quantile(stress, 0.97)))
    colors = example.model.shape_color.numpy()
    colors[example.model.shape_type.numpy() == int(newton.GeoType.PLANE)] = 0.55
    example.model.shape_color.assign(colors)
    viewer.show_triangles = viewer.show_deformable_visual_meshes = False
    viewer.set_camera(wp.vec3(*place), pitch, yaw)
    renderer = viewer.renderer
    renderer.sky_upper, renderer.sky_lower = (0.8, 0.86, 0.94), (0.97, 0.97, 0.97)
    viewer.begin_frame(example.sim_time)
    viewer.log_state(example.state_0)
    uvs = np.stack([np.clip(stress / limit, 0.002, 0.998), np.full(len(stress), 0.5)], axis=1)
    viewer.log_mesh(
        "stress",
        wp.array(points, dtype=wp.vec3),
        wp.array(triangles, dtype=wp.int32),
        uvs=wp.array(uvs, dtype=wp.vec2),
        texture=np.tile(np.rint(255 * stress_colors()).astype(np.uint8), (4, 1, 1)),
        backface_culling=False,
    )
    mesh = viewer.objects["stress"]
    roughness, metallic, checker, _ = mesh.material
    mesh.material, mesh.color = (roughness, metallic, checker, 1.0), (1.0, 1.0, 1.0)  # by its texture
    viewer.end_frame()
    picture = viewer.get_frame().numpy()
    viewer.close()
    parts = picture.reshape(HEIGHT, FINER, WIDTH, FINER, 3).astype(float)
    return parts.mean(axis=(1, 3)).round().astype(np.uint8), limit


def main(path):
    newton.ModelBuilder.finalize = with_stress(newton.ModelBuilder.finalize)
    figure = Figure(figsize=(12.0, 3.3), dpi=100)
    for column, (name, frame, place, pitch, yaw, said) in enumerate(PANELS):
        picture, limit = draw(name, frame, place, pitch, yaw)
        ax = figure.add_axes((column / 3, 0.0, 1 / 3, HEIGHT / 330))
        ax.imshow(picture, interpolation="nearest")
        ax.set_axis_off()
        ax.set_title(f"{said}; dark: {limit / 1e3:g} kPa", fontsize=11, color="#33303a", pad=5)
    figure.savefig(path)
    print(f"wrote {path}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "newton.png")
