"""Methods of visibility: the members that one gives, and their tables."""

import inspect
import re

import pytest

from warpshadow.pipeline.methods.cell_lobes import CellLobes
from warpshadow.pipeline.methods.directional import Directional
from warpshadow.pipeline.methods.log_sh import LogSH
from warpshadow.pipeline.methods.none import NoShadows
from warpshadow.pipeline.methods.ray_traced import RayTraced, TracedLobes
from warpshadow.pipeline.shading.lobe_light import LobeVisibility
from warpshadow.pipeline.shading.method import Method
from warpshadow.pipeline.shading.visibility_steps import VisibilitySteps


def table(kind):
    """Rows of the table in the docstring of a class: members, and the default."""
    rows = [line.strip(" |").split(" | ") for line in inspect.getdoc(kind).splitlines() if line.startswith("| :")]
    return [(re.findall(r":\w+:`(\w+)`", members), default) for members, _, default in rows]


def refuses(function):
    return "raise NotImplementedError" in inspect.getsource(function)


@pytest.mark.parametrize(("kind", "row_count"), [(Method, 9), (VisibilitySteps, 13), (LobeVisibility, 4)])
def test_the_table_of_members_says_which_have_a_default(kind, row_count):
    rows = table(kind)
    defaults = {name: default for names, default in rows for name in names}
    abstract = getattr(kind, "__abstractmethods__", ())
    own = {name for name in abstract if name in vars(kind)} | {"free_basis"} & set(defaults)
    assert len(rows) == row_count and {name for name, default in defaults.items() if default == "–"} == own
    refused = {name for name, function in vars(kind).items() if inspect.isfunction(function) and refuses(function)}
    assert {name for name, default in defaults.items() if default == "refused"} == refused


@pytest.mark.parametrize("kind", [Directional, LogSH, NoShadows, RayTraced, CellLobes, TracedLobes])
def test_each_member_that_a_method_overrides_is_in_a_table(kind):
    bases = (LobeVisibility,) if issubclass(kind, LobeVisibility) else (Method, VisibilitySteps)
    listed = {name for base in bases for names, _ in table(base) for name in names}
    members = {name for base in bases for name, member in vars(base).items() if not isinstance(member, bool)}
    overridden = {name for name in vars(kind) if name in members and not name.startswith("_")} - {"why_no_shadows"}
    assert overridden and overridden <= listed


@pytest.mark.parametrize("kind", [Directional, LogSH, NoShadows, RayTraced])
def test_each_method_gives_what_is_always_needed(kind):
    assert not kind.__abstractmethods__


def test_a_method_that_lacks_a_member_is_refused_when_it_is_made():
    class Half(RayTraced):
        emitted_light_node = Method.emitted_light_node

    with pytest.raises(TypeError, match="emitted_light_node"):
        Half(None, None)
