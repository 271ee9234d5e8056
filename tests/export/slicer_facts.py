"""What Slicer's published schema and sources say of the files that are written for it: names, types, values.

Read from Slicer/Slicer (file, commit):

- Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json 156710434118, and the address by which Slicer 5
  itself names it
- Libs/MRML/Core/vtkMRMLDisplayNode.cxx 05c69496d605, vtkMRMLStorageNode.cxx 028ae4fffdf2,
  vtkMRMLTransformStorageNode.cxx 015d346b907f, vtkMRMLTransformNode.cxx 0ae7c609d438, vtkMRMLLinearTransformNode.cxx
  11df881b46c9, vtkMRMLParser.cxx 0cfa4b2eacad
"""

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)

TYPES = ("Fiducial", "Line", "Angle", "Curve", "ClosedCurve", "Plane", "ROI")

MARKUP = {
    **dict.fromkeys(("type", "name", "coordinateSystem", "coordinateUnits", "labelFormat"), str),
    **dict.fromkeys(("roiType", "planeType", "sizeMode"), str),
    **dict.fromkeys(("locked", "fixedNumberOfControlPoints"), bool),
    "autoScalingSizeFactor": float,
    "center": 3,
    "normal": 3,
    "size": 3,
    "planeBounds": 4,
    "objectToBase": 16,
    "baseToNode": 16,
    "orientation": 9,
    "controlPoints": list,
    "display": dict,
}
"""Properties of a markup: a type, or how many numbers."""
POINT = {
    **dict.fromkeys(("id", "label", "description", "associatedNodeID", "positionStatus"), str),
    "position": 3,
    "orientation": 9,
    **dict.fromkeys(("selected", "locked", "visibility"), bool),
}
"""Properties of a control point."""
VALUES = {
    "type": TYPES,
    "coordinateSystem": ("LPS", "RAS"),
    "coordinateUnits": ("mm", "um"),
    "positionStatus": ("undefined", "preview", "defined"),
}
"""What some of them may be."""
BOOLEAN = ("true", "false")
NUMBER = float
DISPLAY = {
    **dict.fromkeys(("visibility", "visibility2D", "visibility3D", "scalarVisibility", "backfaceCulling"), BOOLEAN),
    **dict.fromkeys(("frontfaceCulling", "edgeVisibility", "clipping", "lighting", "shading"), BOOLEAN),
    **dict.fromkeys(("opacity", "lineWidth", "pointSize", "ambient", "diffuse", "specular", "power"), NUMBER),
    "color": 3,
    "selectedColor": 3,
    "edgeColor": 3,
    "scalarRange": 2,
    "scalarRangeFlag": ("UseManual", "UseData", "UseColorNode", "UseDataType", "UseDirectMapping"),
    "colorNodeID": str,
    "activeScalarName": str,
    "activeAttributeLocation": ("point", "cell"),
}
"""Attributes of a display node: words, a number, how many numbers, or any text."""
DATA, STORED = {"references": str}, {"fileName": str}
NODES = {
    "MarkupsLine": DATA,
    "MarkupsFiducial": DATA,
    "Model": DATA,
    "LinearTransform": DATA,
    "MarkupsJsonStorage": STORED,
    "ModelStorage": STORED,
    "TransformStorage": STORED,
    "MarkupsDisplay": DISPLAY,
    "ModelDisplay": DISPLAY,
}
"""Tags by which node classes name themselves, to the attributes that may be written; ``id`` and ``name`` of all."""
SHIPPED = ("vtkMRMLColorTableNodeFileViridis.txt",)
"""Nodes that every Slicer has before a scene is opened; scalars without a color node are not shown."""


def check_properties(value, allowed):
    """Every property known, of its type, with as many numbers, and one of its values."""
    assert set(value) <= set(allowed), set(value) - set(allowed)
    for name, one in value.items():
        kind = allowed[name]
        if isinstance(kind, int):
            assert len(one) == kind and all(type(number) is float for number in one), name
        else:
            assert type(one) is kind, name
        assert one in VALUES.get(name, [one]), name


def check_attributes(node):
    """A scene's node is of a class of Slicer's, with attributes that it reads, and values that they take."""
    allowed, attributes = NODES[node.tag], dict(node.attrib)
    assert attributes.pop("id").startswith(f"vtkMRML{node.tag}Node") and attributes.pop("name")
    for name, text in attributes.items():
        kind = allowed[name]
        if isinstance(kind, tuple):
            assert text in kind, (name, text)
        elif isinstance(kind, int) or kind is NUMBER:
            assert len([float(word) for word in text.split()]) == (1 if kind is NUMBER else kind), (name, text)
        else:
            assert text, name
    if attributes.get("scalarVisibility") == "true":
        assert attributes["colorNodeID"] in SHIPPED and attributes["activeScalarName"]
