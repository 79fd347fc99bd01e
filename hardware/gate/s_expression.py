"""S-expressions of KiCad's files as nested lists of strings."""

import re

Node = list["str | Node"]


def parse(text: str) -> Node:
    """Return the root list of a file's text; strings lose their quotation marks."""
    stack: list[Node] = [[]]
    for token in re.findall(r'"(?:[^"\\]|\\.)*"|[()]|[^\s()]+', text):
        if token == "(":
            stack.append([])
        elif token == ")":
            stack[-2].append(stack.pop())
        else:
            stack[-1].append(token.strip('"'))
    (root,) = stack[0]
    assert isinstance(root, list)
    return root


def children(node: Node, name: str) -> list[Node]:
    """Return the lists in a list that begin with a name."""
    return [one for one in node if isinstance(one, list) and one and one[0] == name]


def child(node: Node, name: str) -> Node:
    """Return the first list in a list that begins with a name."""
    return children(node, name)[0]


def numbers(node: Node, name: str) -> list[float]:
    """Return the numbers of the first list in a list that begins with a name."""
    return [float(str(value)) for value in child(node, name)[1:]]
