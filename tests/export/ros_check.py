"""Plain values as a message of ROS 2: every field known and of its type, then through the wire's own bytes and back."""

import math

import numpy as np
from rosbags.typesys.base import Nodetype

BITS = {
    "int8": 8,
    "int16": 16,
    "int32": 32,
    "int64": 64,
    "uint8": 8,
    "byte": 8,
    "uint16": 16,
    "uint32": 32,
    "uint64": 64,
}


def through_ros(store, value, name):
    """A mapping as a message, through CDR (what ROS sends) and back: as plain values, with every field.

    Args:
        store: The types.
        value: The mapping.
        name: Of the message.
    """
    message = made(store, value, (Nodetype.NAME, name), name)
    return plain(store, store.deserialize_cdr(store.serialize_cdr(message, name), name), name)


def made(store, value, kind, where):
    node, inside = kind
    if node == Nodetype.BASE:
        check_base(value, inside[0], where)
        return value
    if node == Nodetype.NAME:
        fields = dict(store.fielddefs[inside][1])
        assert isinstance(value, dict), where
        assert set(value) <= set(fields), f"{where}: no {set(value) - set(fields)} in {inside}"
        given = {
            field: made(store, value[field], one, f"{where}.{field}") if field in value else default(store, one)
            for field, one in fields.items()
        }
        return store.types[inside](**given)
    assert isinstance(value, list), where
    element, count = inside
    assert len(value) == count if node == Nodetype.ARRAY else not count or len(value) <= count, (where, len(value))
    items = [made(store, one, element, f"{where}[{i}]") for i, one in enumerate(value)]
    return np.array(items, dtype=element[1][0]) if is_number(element) else items


def check_base(value, kind, where):
    """Integers are no floats and fit their bits; floats are finite; a bool is no number."""
    if kind in BITS:
        assert isinstance(value, int) and not isinstance(value, bool), (where, value)
        low = -(2 ** (BITS[kind] - 1)) if kind.startswith("int") else 0
        assert low <= value < low + 2 ** BITS[kind], (where, value)
    else:
        python = {"float32": float, "float64": float, "bool": bool, "string": str}[kind]
        assert type(value) is python, (where, value)
        assert python is not float or math.isfinite(value), (where, value)


def is_number(kind):
    return kind[0] == Nodetype.BASE and kind[1][0] != "string"


def default(store, kind):
    node, inside = kind
    if node == Nodetype.NAME:
        return store.types[inside](**{field: default(store, one) for field, one in store.fielddefs[inside][1]})
    if node == Nodetype.BASE:
        return {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(inside[0], 0)
    element, count = inside
    size = count if node == Nodetype.ARRAY else 0
    return np.zeros(size, element[1][0]) if is_number(element) else [default(store, element)] * size


def plain(store, message, name):
    return {field: plain_value(store, getattr(message, field), one) for field, one in store.fielddefs[name][1]}


def plain_value(store, value, kind):
    node, inside = kind
    if node == Nodetype.NAME:
        return plain(store, value, inside)
    if node == Nodetype.BASE:
        return value
    return value.tolist() if is_number(inside[0]) else [plain_value(store, one, inside[0]) for one in value]


def holds(whole, part):
    """Whether a mapping with all fields holds what another one states."""
    if isinstance(part, dict):
        return all(holds(whole[field], one) for field, one in part.items())
    if isinstance(part, list):
        return len(whole) == len(part) and all(map(holds, whole, part))
    return whole == part
