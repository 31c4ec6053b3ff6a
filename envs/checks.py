"""Checks of the keywords that the domains' constructors take. A wrong one gets a line with its name and its value."""

import numpy as np


def shown(value):
    """The value as Python writes it, on one line: an array's own way takes several."""
    return " ".join(repr(value).split())


def flag(name, value):
    """True or False as a bool.

    Raises:
        ValueError: the value is anything else. So the string "False" does not count as true.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def numbers(name, value, shape=(), low=-np.inf, high=np.inf):
    """A finite number as a float, or an array float64 of that shape.

    Args:
        name: of the keyword, for the message. value: a number, or nested lists or an array of numbers.
        shape: () for a number. low, high: the range, both ends included.

    Raises:
        ValueError: the value has another shape, is not of finite numbers, or is out of range.
    """
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    is_numeric = array.dtype.kind in "iuf" and array.shape == shape
    if not (is_numeric and np.isfinite(array).all() and (array >= low).all() and (array <= high).all()):
        what = f"finite numbers of shape {shape}" if shape else "a finite number"
        if (low, high) != (-np.inf, np.inf):
            what += f" from {low:g} to {high:g}" if high < np.inf else f" of at least {low:g}"
        raise ValueError(f"{name} must be {what}, got {shown(value)}")
    return array.astype(np.float64) if shape else float(array)


def whole(name, value, shape=(), low=1, high=np.inf):
    """A whole number as an int, or an array int64 of that shape; arguments and errors as of `numbers`."""
    number = numbers(name, value, shape, low, high)
    if np.any(np.mod(number, 1) != 0):
        raise ValueError(f"{name} must be whole, got {shown(value)}")
    return number.astype(np.int64) if shape else int(number)


def rows(name, value, width):
    """An array float64 [at least one row, width]; errors as of `numbers`."""
    count = len(value) if np.iterable(value) and hasattr(value, "__len__") else 0
    if count == 0:
        raise ValueError(f"{name} must be a list with at least one entry, got {shown(value)}")
    return numbers(name, value, (count, width))


def positive(name, value, shape=()):
    """Like `numbers`, but all must be above 0."""
    number = numbers(name, value, shape)
    if np.any(np.asarray(number) <= 0):
        raise ValueError(f"{name} must be above 0, got {shown(value)}")
    return number
