"""Statements of Python's syntax tree, and clones: runs of statements that stand in two places."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

CLONE = 8
"""The fewest statements of a clone, nested ones included."""


def is_docstring(node: ast.stmt) -> bool:
    """Whether a statement is a string and nothing else."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def statements(tree: ast.AST) -> int:
    """Count the statements of a tree without docstrings."""
    return sum(isinstance(node, ast.stmt) and not is_docstring(node) for node in ast.walk(tree))


class _Normal(ast.NodeTransformer):
    """Makes names, attributes, and constants equal."""

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return ast.Name("x", ast.Load())

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return ast.Attribute(self.visit(node.value), "x", ast.Load())

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return ast.Constant(0)

    def visit_arg(self, node: ast.arg) -> ast.AST:
        return ast.arg("x", None)


def clones(trees: dict[Path, ast.Module]) -> list[str]:
    """Return the pairs of blocks that have the same run of statements, names and constants made equal."""
    runs: dict[str, list[tuple[str, int]]] = defaultdict(list)
    for path, tree in trees.items():
        parents = (node for node in ast.walk(tree) if not isinstance(node, (ast.Module, ast.ClassDef)))
        blocks = [getattr(node, name, None) for node in parents for name in ("body", "orelse", "finalbody")]
        for lines in blocks:
            block = [node for node in lines if not is_docstring(node)] if isinstance(lines, list) else []
            normal = [ast.dump(_Normal().visit(ast.parse(ast.unparse(node)))) for node in block]
            for first in range(len(block)):
                # Runs of as many statements as hold eight, nested ones included.
                count, last = 0, first
                while last < len(block) and count < CLONE:
                    count += statements(block[last])
                    last += 1
                if count >= CLONE and last - first > 1:
                    runs["\n".join(normal[first:last])].append((f"{path.name}:{block[first].lineno}", id(lines)))
    pairs: dict[tuple[int, int], str] = {}
    for places in runs.values():
        for index, (place, block_id) in enumerate(places):
            for other, other_id in places[index + 1 :]:
                if block_id != other_id:
                    pairs.setdefault((block_id, other_id), f"{place}  {other}")
    return sorted(pairs.values())
