"""Checks of the keywords of the domains' constructors. The error for a wrong one is a line with its name and value."""

import numpy as np


def shown(value):
    """The value's `repr` on one line. That of an array can have several."""
    return " ".join(repr(value).split())


def flag(name, value):
    """Returns True or False as a Python bool.

    Raises:
        ValueError: the value is anything else, also one that Python would take for true, like the string "False".
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def numbers(name, value, shape=(), low=-np.inf, high=np.inf):
    """Returns a finite number as a float or, with a shape, finite numbers as a float64 array of that shape.

    Args:
        name: the keyword's name, for the message.
        value: a number, or numbers in nested lists or an array.
        shape: what the value must have; () asks for a single number.
        low, high: the range, both ends included.

    Raises:
        ValueError: the value has another shape, is not of finite numbers, or is out of range.
    """
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.array(None)  # not numeric, so it is refused below
    valid = array.dtype.kind in "iuf" and array.shape == shape
    valid = valid and np.isfinite(array).all()
    valid = valid and (array >= low).all() and (array <= high).all()
    if not valid:
        expected = f"finite numbers of shape {shape}" if shape else "a finite number"
        if high < np.inf:
            expected += f" from {low:g} to {high:g}"
        elif low > -np.inf:
            expected += f" of at least {low:g}"
        raise ValueError(f"{name} must be {expected}, got {shown(value)}")
    return array.astype(np.float64) if shape else float(array)


def whole(name, value, shape=(), low=1, high=np.inf):
    """Like `numbers`, but for whole numbers from 1 (by default) to 10**15. Returns an int or an int64 array."""
    number = numbers(name, value, shape, low, high)
    if np.any(np.asarray(number) > 10**15):
        raise ValueError(f"{name} must be at most 10**15, got {shown(value)}")
    if np.any(np.mod(number, 1) != 0):
        raise ValueError(f"{name} must be whole, got {shown(value)}")
    return number.astype(np.int64) if shape else int(number)


def rows(name, value, width):
    """Like `numbers`, but for any number of rows of a width, at least one. Returns a float64 array [rows, width]."""
    has_length = np.iterable(value) and hasattr(value, "__len__")  # False for a generator and a 0-d array
    count = len(value) if has_length else 0
    if count == 0:
        raise ValueError(f"{name} must be a list with at least one entry, got {shown(value)}")
    return numbers(name, value, (count, width))


def positive(name, value, shape=()):
    """Like `numbers`, but each number must be above 0."""
    number = numbers(name, value, shape)
    if np.any(np.asarray(number) <= 0):
        raise ValueError(f"{name} must be above 0, got {shown(value)}")
    return number
