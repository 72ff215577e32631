"""Explanations: which stages the next call computes, which it skips, and why."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import numpy as np

from warpshadow.pipeline.node import AnyInput, Call, ExplainRow, Input, Node, Timing


@dataclass(frozen=True)
class Decision:
    """Whether something runs, and why, or why not; it is true if it runs."""

    runs: bool
    why: str

    def __bool__(self) -> bool:
        return self.runs


@dataclass(frozen=True)
class StageReport:
    """A stage of a call; it is true if it runs."""

    name: str
    forward: Decision  # whether it is computed
    backward: Decision  # whether its adjoint is, when gradients are played back
    items: str  # on how many items, in words

    def __bool__(self) -> bool:
        return self.forward.runs


class Explanation:
    """The stages of the next call; as text a table, in which adjoints stand where a gradient is asked for.

    Args:
        image: The node that the call asks for.
        call: The cached values that it starts from.
        timings: How long stages took last, by name.
        is_host: Whether launches wait until they are done, as they do on a CPU.
        hidden: Nodes that are left out.
        notes: Lines below the table.
    Attributes:
        stages: By name, in the order in which they run.
        notes: Further notes, a line each.
    """

    def __init__(
        self,
        image: Node,
        call: Call,
        timings: dict[str, Timing],
        *,
        is_host: bool,
        hidden: Collection[Node] = (),
        notes: Iterable[str] = (),
    ):
        decisions = decide_which_nodes_run(image, call)
        self.stages: dict[str, StageReport] = {}
        for node in decisions:
            if node not in hidden:
                for row in node.rows:
                    self.stages[row.name] = _report(row, node, _row_decision(row, node, decisions[node]))
        self.timings = dict(timings)
        self.notes = list(notes)
        if not is_host:
            self.notes.append("Times are the host's: a launch returns before the GPU is done.")

    def __getitem__(self, name: str) -> StageReport:
        return self.stages[name]

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        rows = [("forward", "", "last", "items", "why")]
        for stage in self.stages.values():
            timing = self.timings.get(stage.name)
            rows.append(_row(stage.name, stage.forward, timing.forward if timing else None, stage.items))
        is_differentiated = any(stage.backward for stage in self.stages.values())
        if is_differentiated:
            rows.append(("backward", "", "last", "items", "why"))
        for stage in reversed(self.stages.values()) if is_differentiated else ():
            timing = self.timings.get(stage.name)
            items = stage.items if stage.backward else ""
            rows.append(_row(stage.name, stage.backward, timing.backward if timing else None, items))
        widths = [max(len(row[column]) for row in rows) for column in range(4)]
        lines = [
            "  ".join([*(cell.ljust(width) for cell, width in zip(row[:4], widths, strict=True)), row[4]]).rstrip()
            for row in rows
        ]
        return "\n".join([*lines, *self.notes])


def shell_notes(shell: np.ndarray | None) -> list[str]:
    """Say how far light is, where it is near."""
    if shell is None:
        return []
    x, y, z, radius = shell.tolist()
    return [f"Light comes from {radius:g} around ({x:g}, {y:g}, {z:g})."]


def decide_which_nodes_run(image: Node, call: Call) -> dict[Node, Decision]:
    """Decide which nodes run when a call asks for an image, in the order in which they do; nothing is computed."""
    decisions: dict[Node, Decision] = {}
    requested: set[Node] = set()

    def visit(node: AnyInput, reason: Decision) -> None:
        """Decide whether a node runs, given the decision of the node that asks for it."""
        if isinstance(node, Input) or node in requested or (node in decisions and not reason):
            return
        if reason:
            requested.add(node)
        node_decision = _decision(node, call, reason)
        # an idle node passes the question on to its inputs
        is_idle = not node_decision and node.value_if_known(call) is None
        for item in node.dependencies:
            visit(item, reason if is_idle else node_decision)
        decisions[node] = node_decision

    visit(image, Decision(True, "an image is asked for"))
    return decisions


def _decision(node: Node, call: Call, reason: Decision) -> Decision:
    """Whether a node runs, given why it is asked for, or why it is not."""
    if node.row is not None and (idle := _text(node.row.why_idle)):
        return Decision(False, idle)
    if node.value_if_known(call) is not None:
        return Decision(False, f"cached: {_names(node.root_inputs)} are the same")
    return _reason_to_run([node], reason, "nothing is cached yet" if node.caches else "")


def _reason_to_run(inputs: Iterable[AnyInput], reason: Decision, otherwise: str = "") -> Decision:
    """Whether a stage of some inputs runs, given why it is asked for: the input that changed, if one did."""
    if not reason:
        return reason
    root_inputs = dict.fromkeys(root for item in inputs for root in item.root_inputs)
    if varying := [root for root in root_inputs if root.requires_grad]:
        return Decision(True, f"a gradient to {_names(varying)} is asked for")
    if reasons := [root.why_new for root in root_inputs if root.why_new]:
        return Decision(True, _listed(dict.fromkeys(reasons)))
    return Decision(True, otherwise) if otherwise else reason


def _row_decision(row: ExplainRow, node: Node, decision: Decision) -> Decision:
    """Whether a row of a node runs, given the decision about the node."""
    if row is node.row:
        return decision
    if idle := _text(row.why_idle):
        return Decision(False, idle)
    return _reason_to_run(row.inputs, decision)


def _report(row: ExplainRow, node: Node, forward: Decision) -> StageReport:
    """A stage of a node; its adjoint runs if it runs itself and something before it requires a gradient."""
    differentiated = dict.fromkeys(root for item in row.inputs or (node,) for root in item.differentiated_inputs)
    if not forward:
        backward = Decision(False, "nothing is computed")
    elif differentiated and row.has_adjoint:
        backward = Decision(True, f"a gradient to {_names(differentiated)} is asked for")
    else:
        backward = Decision(False, "nothing before it requires a gradient")
    return StageReport(row.name, forward, backward, _text(row.items) if forward else "")


def _names(inputs: Iterable[Input]) -> str:
    return _listed(dict.fromkeys(item.name for item in inputs))


def _text(text: str | Callable[[], str]) -> str:
    return text() if callable(text) else text


def _listed(items: Iterable[str]) -> str:
    """Words with commas and an "and"."""
    *first, last = list(items) or ["all of it"]
    return f"{', '.join(first)} and {last}" if first else last


def _row(name: str, decision: Decision, last: float | None, items: str) -> tuple[str, str, str, str, str]:
    milliseconds = "" if last is None else f"{1e3 * last:.2f} ms"
    return f"  {name}", "runs" if decision else "–", milliseconds, items, decision.why
