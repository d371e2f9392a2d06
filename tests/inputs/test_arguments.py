"""Constructors that are called with wrong arguments."""

import inspect

import pytest

import warp_corot as wc
from warp_corot.inputs.arguments import explained

CLASSES = [
    name
    for name in wc.__all__
    if isinstance(kind := getattr(wc, name), type)
    and inspect.isfunction(kind.__init__)
    and not issubclass(kind, BaseException)
]


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda: wc.Isotropic(1e3),
            "Isotropic: missing a required argument: 'poisson'; "
            "it must be Isotropic(young, poisson, density, toughness=0.0)",
        ),
        (
            lambda: wc.Tool(wc.Sphere(0.1), position=(0, 0, 0)),
            "Tool: got an unexpected keyword argument 'position'; it must be Tool(shape, *, speed=1.0)",
        ),
        (
            lambda: wc.Contact(0.3, fricton=1),
            "Contact: got an unexpected keyword argument 'fricton' (did you mean friction?); it must be Contact(",
        ),
        (lambda: wc.Domain.from_surface(), "Domain.from_surface: missing a required argument: 'surface'; it must be"),
    ],
)
def test_a_call_that_does_not_fit_is_one_line(call, said):
    with pytest.raises(wc.InputError) as raised:
        call()
    assert str(raised.value).startswith(said)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", CLASSES)
def test_every_public_class_names_its_arguments(name):
    with pytest.raises(wc.InputError, match=rf"^{name}: .*; it must be {name}\("):
        getattr(wc, name)(no_such_argument=1)


def test_other_errors_of_types_stay_what_they_are():
    @explained
    class Mine:
        """Mine."""

        def __init__(self, size: int = 3):
            self.size = size + 1

    assert Mine(4).size == 5
    assert str(inspect.signature(Mine)) == "(size: int = 3)"
    with pytest.raises(TypeError, match="can only concatenate"):
        Mine("three")
