"""Elements on the device: deformation gradients in, nodal forces out.

Two kinds share one set of functions, chosen by the type of the struct: tetrahedra of the forest, whose shape is a few
bits, and general tetrahedra with a rest matrix each. Both work in a local frame Q (a proper rotation; the identity for
general elements): ``local_gradient`` gives G = (du/dX) Q, so that Q + G is the local-frame deformation gradient F Q.
Working from displacements keeps small strains free of the cancellation that positions would bring.
"""

import warp as wp

from .shapes import FRAME_SHIFT, LEVEL_BITS, MIRROR_BIT, SQRT2

wp.set_module_options({"enable_backward": False})

LEVEL_MASK = wp.constant((1 << LEVEL_BITS) - 1)
ROOT2 = wp.constant(SQRT2)


@wp.struct
class ForestElements:
    """Tetrahedra of the bisected forest: four nodes and one integer each."""

    nodes: wp.array[wp.vec4i]  # [T] in Maubach order
    code: wp.array[wp.int32]  # [T] level | mirrored << 6 | frame << 7
    frames: wp.array[wp.mat33]  # [n_frames] proper local frames Q
    size: wp.array[wp.float32]  # [levels div 3] edge length h [m]


@wp.struct
class GeneralElements:
    """Tetrahedra of any shape, positively oriented."""

    nodes: wp.array[wp.vec4i]  # [T]
    rest_inverse: wp.array[wp.mat33]  # [T] inverse of the matrix of rest edges (x1-x0, x2-x0, x3-x0) [1/m]
    volume: wp.array[wp.float32]  # [T] rest volume [m^3]


@wp.func
def xyz(a: wp.vec4):
    return wp.vec3(a[0], a[1], a[2])


@wp.func
def shape_of(code: int):
    return (code & LEVEL_MASK) % 3


@wp.func
def mirror_sign(code: int):
    """-1 for an element whose Maubach frame is left-handed: its third column is turned round."""
    return 1.0 - 2.0 * float((code >> MIRROR_BIT) & 1)


@wp.func
def edge_length(elements: ForestElements, t: int):
    return elements.size[(elements.code[t] & LEVEL_MASK) // 3]


@wp.func
def frame(elements: ForestElements, t: int):
    return elements.frames[elements.code[t] >> FRAME_SHIFT]


@wp.func
def frame(elements: GeneralElements, t: int):
    return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@wp.func
def rest_volume(elements: ForestElements, t: int):
    h = edge_length(elements, t)
    volume = h * h * h / 6.0
    shape = shape_of(elements.code[t])
    if shape == 1:
        volume *= 0.5
    elif shape == 2:
        volume *= 0.25
    return volume


@wp.func
def rest_volume(elements: GeneralElements, t: int):
    return elements.volume[t]


@wp.func
def node_displacements(nodes: wp.vec4i, u: wp.array[wp.vec4]):
    return xyz(u[nodes[0]]), xyz(u[nodes[1]]), xyz(u[nodes[2]]), xyz(u[nodes[3]])


@wp.func
def local_gradient(elements: ForestElements, t: int, u: wp.array[wp.vec4]):
    """G = (du/dX) Q [3, 3]: sums and differences by type, divided by the edge length."""
    u0, u1, u2, u3 = node_displacements(elements.nodes[t], u)
    code = elements.code[t]
    shape = shape_of(code)
    c0 = u1 - u0
    c1 = u2 - u1
    c2 = u3 - u2
    if shape == 1:
        c2 = c2 + (u3 - u0)
    elif shape == 2:
        c0 = ROOT2 * (u0 - u2)
        c1 = ROOT2 * (u1 - u2)
        c2 = 2.0 * c2
    inv_h = 1.0 / edge_length(elements, t)
    return wp.matrix_from_cols(c0 * inv_h, c1 * inv_h, c2 * (inv_h * mirror_sign(code)))


@wp.func
def local_gradient(elements: GeneralElements, t: int, u: wp.array[wp.vec4]):
    u0, u1, u2, u3 = node_displacements(elements.nodes[t], u)
    return wp.matrix_from_cols(u1 - u0, u2 - u0, u3 - u0) * elements.rest_inverse[t]


@wp.func
def add_force(f: wp.array[wp.vec4], node: int, force: wp.vec3):
    """The one place where a nodal force is added to the global vector."""
    wp.atomic_add(f, node, wp.vec4(force[0], force[1], force[2], 0.0))


@wp.func
def scatter_stress(elements: ForestElements, t: int, p: wp.mat33, f: wp.array[wp.vec4]):
    """Add the nodal forces -V P grad N_i, where P = P_world Q is the local-frame first Piola-Kirchhoff stress [Pa]."""
    nodes = elements.nodes[t]
    code = elements.code[t]
    shape = shape_of(code)
    area = rest_volume(elements, t) / edge_length(elements, t)
    p0 = wp.vec3(p[0, 0], p[1, 0], p[2, 0]) * area
    p1 = wp.vec3(p[0, 1], p[1, 1], p[2, 1]) * area
    p2 = wp.vec3(p[0, 2], p[1, 2], p[2, 2]) * (area * mirror_sign(code))
    f0 = p0
    f1 = p1 - p0
    f2 = p2 - p1
    f3 = -p2
    if shape == 1:
        f0 = p0 + p2
        f3 = -2.0 * p2
    elif shape == 2:
        f0 = -ROOT2 * p0
        f1 = -ROOT2 * p1
        f2 = ROOT2 * (p0 + p1) + 2.0 * p2
        f3 = -2.0 * p2
    add_force(f, nodes[0], f0)
    add_force(f, nodes[1], f1)
    add_force(f, nodes[2], f2)
    add_force(f, nodes[3], f3)


@wp.func
def scatter_stress(elements: GeneralElements, t: int, p: wp.mat33, f: wp.array[wp.vec4]):
    nodes = elements.nodes[t]
    h = (-elements.volume[t]) * p * wp.transpose(elements.rest_inverse[t])
    f1 = wp.vec3(h[0, 0], h[1, 0], h[2, 0])
    f2 = wp.vec3(h[0, 1], h[1, 1], h[2, 1])
    f3 = wp.vec3(h[0, 2], h[1, 2], h[2, 2])
    add_force(f, nodes[0], -(f1 + f2 + f3))
    add_force(f, nodes[1], f1)
    add_force(f, nodes[2], f2)
    add_force(f, nodes[3], f3)
