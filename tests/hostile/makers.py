"""Hostile inputs, by name: each function writes what a story of cases.toml is about into a folder."""

import json

import numpy as np
from case_world import case_text, structure, whole, write_balls
from mesh_bytes import glb

from puncture_twin.planning.certify.cells import Cells
from puncture_twin.planning.certify.certificate import Certificate, Question, write_certificate
from puncture_twin.planning.plan.plan_document import write_plan
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.recording_file import write_recording
from puncture_twin.twin.plant.simulated_recording import simulate_recording

SKIN, ORGAN, RIB = (
    structure(name, role, {"mesh": f"{name}.ply", "unit": "mm"})
    for name, role in (("skin", "skin"), ("organ", "target"), ("rib", "avoid"))
)
CASE = case_text(SKIN, ORGAN, name="hostile")
MOUNT = "[robot.mount]\nposition_mm = [300.0, 0.0, 0.0]\nx_axis = [1.0, 0.0, 0.0]\nz_axis = [0.0, 0.0, 1.0]\n"
STRUCTURE = RIB.replace('"rib"', '"s{0}"')


def sound_case(folder, text=CASE + RIB):
    write_balls(folder, ending="ply")
    (folder / "case.toml").write_text(whole(text))


def case_with(before="", after="", old="", new=""):

    def make(folder):
        text = CASE + RIB
        assert old in text
        sound_case(folder, before + text.replace(old, new, 1) + after)

    return make


def toml_file(name, text):

    def make(folder):
        (folder / name).write_text(text)

    return make


def glb_document(vertices, primitives, nodes):
    size = 12 * vertices
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": size}],
        "bufferViews": [{"buffer": 0, "byteLength": size}],
        "accessors": [{"componentType": 5126, "count": vertices, "type": "VEC3", "bufferView": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * primitives}],
        "nodes": [{"mesh": 0}] * nodes,
        "scenes": [{"nodes": list(range(nodes))}],
    }


def glb_placed_often(folder):
    (folder / "rib.glb").write_bytes(glb(glb_document(3, 1, 200_000), np.eye(3, dtype="<f4").tobytes()))


def glb_of_one_array(folder):
    points = np.random.default_rng(1).normal(size=(6000, 3)).astype("<f4")
    (folder / "rib.glb").write_bytes(glb(glb_document(6000, 9000, 1), points.tobytes()))


def certificate(folder):
    question = Question(
        case_name="hostile",
        inputs={},
        target_ct=np.zeros(3),
        R_ct_entry=np.eye(3),
        theta=(0.2, 0.4),
        beta=(0.1, 0.3),
        length=210.0,
        standoff=None,
        skin_gap=10.0,
        farthest=360.0,
        radius=0.6,
        longest=150.0,
        max_skin_angle=1.0,
        structures=("rib",),
        margins=np.zeros(1),
    )
    empty = np.array([""])
    one = Certificate(
        question,
        0.5,
        ("S",),
        Cells(np.array([[0.2, 0.4]]), np.array([[0.1, 0.3]])),
        np.array(["S"]),
        empty,
        empty,
        np.array([-1]),
        np.array([np.nan]),
        1,
    )
    write_certificate(one, folder / "certificate.json")
    return (folder / "certificate.json").read_text()


def certificate_with(old, new):

    def make(folder):
        sound_case(folder)
        text = certificate(folder)
        assert old in text
        (folder / "certificate.json").write_text(text.replace(old, new, 1))

    return make


def recording(change=lambda r: r, edit=lambda text: text):

    def make(folder):
        sound = simulate_recording(np.random.default_rng(1), 30)[0]
        write_recording(change(sound), folder / "recording.csv")
        text = (folder / "recording.csv").read_text()
        (folder / "recording.csv").write_bytes(edit(text).encode())

    return make


def scaled(T, factor):
    T = np.array(T)
    T[:, :3, 3] *= factor
    return T


def read_as(A=lambda r: r.A, B=lambda r: r.B, P=lambda r: r.P):
    return lambda r: Recording(A(r), B(r), P(r), r.v, r.names)


JOINTS = "time_s,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad\n0,0,-1.5,0,-1.5,0,0\n"


def joints(text):

    def make(folder):
        sound_case(folder, CASE + RIB + MOUNT)
        (folder / "joints.csv").write_bytes(text.encode())

    return make


def plan_with(change):

    def make(folder):
        from fuzz.corpus import straight_plan

        write_plan(straight_plan(), folder / "plan.json")
        document = json.loads((folder / "plan.json").read_text())
        change(document)
        (folder / "plan.json").write_text(json.dumps(document))

    return make


def turn(document):
    document["insertion"]["q_rad"][1][0] = 1000.0


def overflow(document):
    document["insertion"]["q_rad"][1][0] = 1e308


def vast_rotation(document):
    document["T_base_ct"] = [
        [1e200, 1e200, 1e200, 0],
        [1e200, -1e200, 1e200, 0],
        [1e200, 1e200, -1e200, 0],
        [0, 0, 0, 1],
    ]


MAKERS = {
    "sound case": sound_case,
    "sound case with an arm": joints(JOINTS),
    "sound recording": recording(),
    "arrays nested": case_with(before="a = " + "[" * 5000 + "]" * 5000 + "\n"),
    "inline tables nested": case_with(before="a = " + "{b = " * 3000 + "1" + "}" * 3000 + "\n"),
    "long integer": case_with(old="210.0", new="2" * 5000),
    "number beyond floats": case_with(old="210.0", new="1e400"),
    "long case name": case_with(old='"hostile"', new='"' + "n" * 5000 + '"'),
    "long structure name": case_with(old='"rib"', new='"' + "n" * 5000 + '"'),
    "long file name": case_with(old='"rib.ply"', new='"' + "n" * 5000 + '.ply"'),
    "NUL in a file name": case_with(old='"rib.ply"', new='"rib\\u0000.ply"'),
    "long bare key": case_with(before="k" * 5000 + " = 1\n"),
    "long quoted key": case_with(before='"' + "k" * 5000 + '" = 1\n'),
    "dotted key": case_with(before=".".join(["a"] * 20_000) + " = 1\n"),
    "dotted key over lines": case_with(before="[" + ".".join(["a"] * 9000) + "]\nb = 1\n"),
    "dotted keys of quoted parts": case_with(before='""' + '.""' * 5000 + " = 1\n"),
    "many tables": case_with(after="".join(f"[t{i}.b.c.d.e.f]\n" for i in range(40_000))),
    "many structures": case_with(after="".join(STRUCTURE.format(i) for i in range(12_000))),
    "many patterns": case_with(
        after='[[structures]]\nlabelmap = "x.nii"\nignore = [\n' + '"*a*b*c",\n' * 60_000 + "]\n"
    ),
    "nothing to avoid": lambda folder: sound_case(folder, CASE),
    "servo nested": toml_file("servo.toml", "a = " + "[" * 5000 + "]" * 5000),
    "servo long integer": toml_file("servo.toml", "schema = " + "1" * 5000),
    "selfcal nested": toml_file("selfcal.toml", "a = " + "[" * 5000 + "]" * 5000),
    "selfcal dotted key": toml_file("selfcal.toml", ".".join(["a"] * 20_000) + " = 1\n"),
    "collision nested": toml_file("x.collision.toml", "a = " + "[" * 5000 + "]" * 5000),
    "certificate queries": certificate_with('"queries": 1,', '"queries": 1e400,'),
    "certificate triangle": certificate_with('"", "", -1,', '"", "", 1e400,'),
    "certificate length": certificate_with('"length_mm": 210.0', '"length_mm": 1e400'),
    "certificate huge integer": certificate_with('"", "", -1,', '"", "", ' + "9" * 4000 + ","),
    "recording lone CR": recording(edit=lambda text: text.replace("\n3,", "\n3\r,", 1)),
    "recording long field": recording(edit=lambda text: text.replace("\n3,", "\n" + "3" * 140_000 + ",", 1)),
    "recording open quote": recording(edit=lambda text: text.replace("\n3,", '\n"3,', 1)),
    "recording many columns": recording(edit=lambda text: "column," * 5000 + text),
    "recording inverse": recording(read_as(A=lambda r: np.linalg.inv(r.A), B=lambda r: np.linalg.inv(r.B))),
    "recording A inverse": recording(read_as(A=lambda r: np.linalg.inv(r.A))),
    "recording B inverse": recording(read_as(B=lambda r: np.linalg.inv(r.B))),
    "recording in metres": recording(read_as(A=lambda r: scaled(r.A, 1e-3), B=lambda r: scaled(r.B, 1e-3))),
    "recording all in metres": recording(
        read_as(A=lambda r: scaled(r.A, 1e-3), B=lambda r: scaled(r.B, 1e-3), P=lambda r: r.P / 1000)
    ),
    "recording image in metres": recording(read_as(P=lambda r: r.P / 1000)),
    "recording in cm": recording(read_as(A=lambda r: scaled(r.A, 0.1), B=lambda r: scaled(r.B, 0.1))),
    "recording swapped": recording(read_as(A=lambda r: r.B, B=lambda r: r.A)),
    "recording by columns": recording(
        read_as(
            A=lambda r: np.block([[r.A[:, :3, :3].transpose(0, 2, 1), r.A[:, :3, 3:]], [r.A[:, 3:]]]),
            B=lambda r: np.block([[r.B[:, :3, :3].transpose(0, 2, 1), r.B[:, :3, 3:]], [r.B[:, 3:]]]),
        )
    ),
    "recording of other pictures": recording(read_as(P=lambda r: np.roll(r.P, 1, axis=0))),
    "joints lone CR": joints(JOINTS.replace("\n0,", "\n0\r,")),
    "joints long field": joints(JOINTS + "1" * 140_000 + ",0,0,0,0,0,0\n"),
    "joints NUL": joints(JOINTS + "1\0,0,0,0,0,0,0\n"),
    "plan that turns": plan_with(turn),
    "plan that overflows": plan_with(overflow),
    "plan of a vast rotation": plan_with(vast_rotation),
    "certificate of a vast size": certificate_with('"size_rad": 0.5', '"size_rad": 1e308'),
    "GLB placed often": glb_placed_often,
    "GLB of one array": glb_of_one_array,
}
