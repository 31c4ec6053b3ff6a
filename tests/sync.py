"""Keeps the blocks that algorithm scripts share identical: `python tests/sync.py` rewrites the copies.

A block stands between `# >>> name, identical to source.py` and `# <<< name`; the source has the same markers.
"""

import difflib
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^ *# >>> ([\w ]+), identical to (\w+\.py)\n(.*?)^ *# <<< \1\n", re.MULTILINE | re.DOTALL)


def scripts(root=ROOT):
    """The algorithm scripts: {file name: text}."""
    return {path.name: path.read_text() for path in sorted(root.glob("*.py"))}


def synced(texts):
    """The texts with every block replaced by its source's.

    Raises:
        ValueError: a marker without its end, a source or block that does not exist, or a block that occurs twice.
    """
    blocks = {}
    for name, text in texts.items():
        for match in BLOCK.finditer(text):
            if (name, match[1]) in blocks:
                raise ValueError(f"{name} has the block {match[1]!r} twice")
            blocks[name, match[1]] = match[0]
        if text.count("# >>> ") != text.count("# <<< ") or text.count("# >>> ") != sum(
            key[0] == name for key in blocks
        ):
            raise ValueError(f"{name} has a marker of a block without its other end")

    def source(match):
        if (match[2], match[1]) not in blocks:
            raise ValueError(f"the block {match[1]!r} is said to come from {match[2]}, which has none of that name")
        return blocks[match[2], match[1]]

    return {name: BLOCK.sub(source, text) for name, text in texts.items()}


def differences(texts):
    """A unified diff from the scripts as they are to the scripts with their blocks rewritten; empty if in sync."""
    lines = []
    for name, text in synced(texts).items():
        lines += difflib.unified_diff(texts[name].splitlines(), text.splitlines(), name, f"{name} in sync", lineterm="")
    return "\n".join(lines)


if __name__ == "__main__":
    before = scripts()
    for name, text in synced(before).items():
        if text != before[name]:
            (ROOT / name).write_text(text)
            print(f"rewrote {name}")
