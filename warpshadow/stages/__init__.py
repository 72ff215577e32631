"""Stages of an image: functions of Warp's arrays, to be composed as :class:`warpshadow.Renderer` composes them.

A module here is a stage, or code that stages share; README.md lists them in their order, and ``facade.py`` the names
that this package exports. All of them are imported when the first is asked for: a stage alone costs its own module.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warpshadow.stages.facade import *  # noqa: F403
else:

    def __getattr__(name: str) -> object:
        return getattr(importlib.import_module("warpshadow.stages.facade"), name)
