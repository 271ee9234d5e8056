"""Small valid files of every kind that the program reads, made here: what the mutators start from."""

import gzip
import hashlib
import json

import dicom_world as world
import h5py
import numpy as np
import SimpleITK
import trimesh
from case_world import MARKERS, registration_section, whole
from hostile.makers import CASE, MOUNT, RIB, certificate, recording, sound_case
from mesh_bytes import glb, vtp
from pydicom.uid import ImplicitVRLittleEndian, JPEGBaseline8Bit, RLELossless
from slicer_files import vtk_model

from puncture_twin.meshes import folder as embedded
from puncture_twin.planning.arm.insertion import ReachRequest
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.output.manifest import Manifest, ManifestEntry
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.workcell import case_tool
from puncture_twin.planning.export.exporter import csv_text
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_document import write_plan
from puncture_twin.planning.reach.reach import assess_reach_all
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.twin.pictures import png_bytes

REGISTRATION = registration_section()
TABLE = '[[obstacle]]\nname = "table"\nframe = "ct"\ncenter_mm = [0.0, 160.0, 0.0]\nsize_mm = [600.0, 40.0, 2000.0]\n'
LABELS = (
    '[[structures]]\nlabelmap = "labels.seg.nrrd"\navoid = { "ves*" = 2.0 }\nignore = ["bone"]\n'
    '[[structure]]\nname = "lesion"\nlabelmap = "labels.nii.gz"\nlabel = 2\nrole = "unknown"\nmargin_mm = 1.0\n'
)
CHECKS = (
    'case = "case.toml"\n[[check]]\ntheta_deg = 20\nbeta_deg = 135\nverdict = "rejected"\nreason = "too_close"\n'
    'structure = "rib"\nclearance_mm = { rib = 41.2 }\ntolerance_mm = 0.1\n[[check]]\ntheta_deg = 0\nbeta_deg = 0\n'
    'verdict = "safe"\n'
)
FCSV = (
    "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,"
    "label,desc,associatedNodeID\n1,0,0,80,0,0,0,1,1,1,0,A,,\n2,50,0,75,0,0,0,1,1,1,0,B,,\n3,0,60,70,0,0,0,1,1,1,0,C,,\n"
)

DICOM_SHAPE = (6, 5, 3)

SET_FILES = ("map.png", "sub/candidates.parquet", "plan.json", "sub/scene.png", "left.csv", "gone/report.html")
"""Of an output folder: two of ``search``, two of ``plan``, two that an interrupted run left."""

STANDOFF_MM = 8.0
"""Short, so that the plan has few rows."""


def make_corpus(folder):
    make_meshes(folder)
    make_volumes(folder)
    make_dicom(folder)
    make_points(folder)
    make_transforms(folder)
    sound_case(folder, CASE + RIB)
    text = CASE + RIB + LABELS + REGISTRATION + TABLE
    (folder / "full.toml").write_text(whole(text, listed=1))
    (folder / "mount.toml").write_text(whole(CASE + RIB + MOUNT))
    (folder / "x.collision.toml").write_text(CHECKS)
    for name in ("head/servo.toml", "head/head.ply", "head/markers.csv", "head/targets.csv", "selfcal/selfcal.toml"):
        (folder / name.split("/")[1]).write_bytes((embedded() / name).read_bytes())
    certificate(folder)
    recording()(folder)
    plan = straight_plan()
    write_plan(plan, folder / "plan.json")
    (folder / "times.csv").write_text(csv_text(plan, case_checked=True))
    joints = [f"{number / 10},{','.join(map(repr, row))}" for number, row in enumerate(plan.insertion.q.tolist())]
    (folder / "set.json").write_text(output_set_manifest())
    (folder / "joints.csv").write_text("\n".join(["time_s," + ",".join(f"q{j}_rad" for j in range(1, 7)), *joints]))


def make_transforms(folder):
    euler = SimpleITK.Euler3DTransform([10.0, -20.0, 30.0], 0.1, 0.2, 0.3, [300.0, 0.0, -90.0])
    for name in ("transform.h5", "transform.tfm"):
        both = SimpleITK.CompositeTransform([euler, SimpleITK.AffineTransform(3)])
        SimpleITK.WriteTransform(both, str(folder / name))
    with h5py.File(folder / "transform.h5") as new, h5py.File(folder / "earliest.h5", "w", libver="earliest") as old:
        new.copy("TransformGroup", old)  # without the checksums that refuse most changes


def output_set_manifest():
    search = ManifestEntry(
        "1.0", (Input("case", "case.toml", "0" * 64),), (), {name: digest_of(name) for name in SET_FILES[:2]}
    )
    plan = ManifestEntry("1.0", search.inputs, ("search",), {name: digest_of(name) for name in SET_FILES[2:4]})
    return Manifest({"search": search, "plan": plan}, tuple(SET_FILES[4:])).text()


def digest_of(name):
    return hashlib.sha256(name.encode()).hexdigest()


def make_meshes(folder):
    spheres = [trimesh.creation.icosphere(subdivisions=1, radius=radius) for radius in (20.0, 9.0)]
    spheres[1].apply_translation([60.0, 0.0, 0.0])
    mesh = trimesh.util.concatenate(spheres)
    mesh.export(folder / "a.stl")
    mesh.export(folder / "ascii.stl", file_type="stl_ascii")
    mesh.export(folder / "a.obj", include_normals=False, include_texture=False)
    mesh.export(folder / "a.ply", encoding="binary", vertex_normal=False)
    mesh.export(folder / "ascii.ply", encoding="ascii", vertex_normal=False)
    vertices, faces = mesh.vertices.astype("<f4"), mesh.faces.astype("<u4")
    (folder / "a.glb").write_bytes(glb(gltf(vertices, faces), vertices.tobytes() + faces.tobytes()))
    (folder / "ascii.vtp").write_bytes(vtp(mesh.vertices, mesh.faces.tolist()))
    (folder / "base64.vtp").write_bytes(vtp(mesh.vertices, mesh.faces.tolist(), "binary", compressed=True))
    (folder / "a.vtk").write_bytes(vtk_model(mesh.vertices, mesh.faces))
    noted = "FIELD FieldData 1\nname 1 1 string\n\x7fMETADATA\nINFORMATION 0\n\n"
    stripped = vtk_model(mesh.vertices, mesh.faces, extra=noted).replace(b"\x7f", b"\xc5liver\n")
    (folder / "strips.vtk").write_bytes(stripped.replace(b"POLYGONS", b"triangle_strips"))
    (folder / "ascii.vtk").write_bytes(vtk_model(mesh.vertices, mesh.faces, binary=False))


def gltf(vertices, faces):
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"mesh": 0, "children": [1]},
            {"mesh": 0, "translation": [0.0, 50.0, 0.0], "rotation": [0.0, 0.6, 0.0, 0.8], "scale": [1.0, 2.0, 1.0]},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"componentType": 5126, "count": len(vertices), "type": "VEC3", "bufferView": 0},
            {"componentType": 5125, "count": faces.size, "type": "SCALAR", "bufferView": 1},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": vertices.nbytes},
            {"buffer": 0, "byteLength": faces.nbytes, "byteOffset": vertices.nbytes},
        ],
        "buffers": [{"byteLength": vertices.nbytes + faces.nbytes}],
    }


def make_volumes(folder):
    labels = np.zeros((26, 12, 10), np.uint8)
    labels[15:20, 3:8, 3:8] = 1
    labels[21:24, 4:9, 4:8] = 2
    image = SimpleITK.GetImageFromArray(labels)
    image.SetSpacing((2.0, 2.5, 3.0))
    image.SetOrigin((-10.0, -15.0, -6.0))  # the map holds the target, its labels lie in front of it
    SimpleITK.WriteImage(image, folder / "labels.nii.gz")
    (folder / "labels.nii").write_bytes(gzip.decompress((folder / "labels.nii.gz").read_bytes()))
    SimpleITK.WriteImage(image, folder / "raw.nrrd", useCompression=False)
    SimpleITK.WriteImage(image, folder / "gzip.nrrd", useCompression=True)
    SimpleITK.WriteImage(image, folder / "labels.nhdr", useCompression=False)
    named = (folder / "raw.nrrd").read_bytes()
    names = b"Segment0_Name:=vessel\nSegment0_LabelValue:=1\nSegment1_Name:=bone\nSegment1_LabelValue:=2\n"
    (folder / "labels.seg.nrrd").write_bytes(named.replace(b"\n\n", b"\n" + names + b"\n", 1))
    hu = SimpleITK.Cast(image, SimpleITK.sitkFloat32) * 100.0 - 50.0
    hu.CopyInformation(image)
    SimpleITK.WriteImage(hu, folder / "ct.nii.gz")
    SimpleITK.WriteImage(hu, folder / "ct.nrrd", useCompression=False)


def make_dicom(folder):
    T, stored = world.affine(), world.phantom(DICOM_SHAPE)
    slices = world.series(stored, T)
    slices[1].compress(RLELossless)
    for number, (one, syntax) in enumerate(zip(slices, (None, None, ImplicitVRLittleEndian), strict=True)):
        world.write(one, folder / f"slice{number}.dcm", syntax)
    world.write(world.enhanced(stored, T), folder / "enhanced.dcm")
    mask = np.zeros(DICOM_SHAPE, bool)
    mask[2:4, 1:4, :2] = True
    world.write(world.segmentation({"liver": mask, "vessel": np.roll(mask, 1, 0)}, T), folder / "seg.dcm")
    contours = [(T @ np.array([[1, 4, 4, 1], [1, 1, 3, 3], [k] * 4, [1] * 4])).T[:, :3] for k in range(2)]
    data = world.structure_set({"liver": contours, "vessel": contours[:1]})
    for element in data.iterall():
        if element.VR == "SQ":
            element.is_undefined_length = True
    world.write(data, folder / "rt.dcm")
    grey = np.arange(2 * 9 * 8, dtype=np.uint8).reshape(2, 9, 8)
    seen = world.ultrasound(grey, delta_cm=(0.02, 0.02), box=(1, 1, 6, 7), spacing=(0.2, 0.2))
    world.write(seen, folder / "seen.dcm")
    cells = np.repeat(np.arange(2 * 16 * 16, dtype=np.uint8).reshape(2, 16, 16, 1), 3, axis=3)
    coloured = world.ultrasound(cells, spacing=(0.2, 0.2), PhotometricInterpretation="YBR_FULL_422")
    world.write(world.encoded(coloured, JPEGBaseline8Bit, cells), folder / "clip.dcm")
    (folder / "seen.png").write_bytes(png_bytes(grey[0]))


def make_points(folder):
    for name in ("markers_ct.csv", "touch.csv"):
        (folder / name).write_text(MARKERS)
    (folder / "kinds.csv").write_text("name,kind,x_cm,y_cm,z_cm\nA,fid,0,0,8\nB,fid,5,0,7.5\nC,bone,0,6,7\n")
    rows = [line.split(",") for line in MARKERS.splitlines()[1:]]
    points = [{"label": name, "position": [float(x) for x in xyz], "positionStatus": "defined"} for name, *xyz in rows]
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    (folder / "a.mrk.json").write_text(json.dumps({"markups": [markup]}, indent=1))
    (folder / "a.fcsv").write_text(FCSV)
    (folder / "names.csv").write_text("id,name\n1,vessel\n2,bone\n3,liver\n")


def evenly(times_s, q):
    even = SAMPLE_S * np.arange(int(np.ceil(times_s[-1] / SAMPLE_S)) + 1)
    stretched = times_s * (even[-1] / times_s[-1])
    return Trajectory(even, np.stack([np.interp(even, stretched, joint) for joint in q.T], axis=1))


def straight_plan():
    case = load_case(embedded() / "abdomen")
    T = load_placement(case).T_base_ct
    target = T[:3, :3] @ case.target_ct + T[:3, 3]
    checker = CellChecker(ur_model("ur3"), case_tool(case))
    for tilt in np.linspace(-0.6, 0.6, 13):
        outward_ct = np.array([-np.sin(abs(tilt)), -np.cos(tilt), 0.0])
        outward_ct /= np.linalg.norm(outward_ct)
        answer = assess_reach_all(
            checker, [ReachRequest(target, T[:3, :3] @ outward_ct, case.needle.length_mm, STANDOFF_MM)]
        )[0]
        if answer.reachable:
            break
    q, depth = answer.insertion_q, np.asarray(answer.insertion_depth_mm)
    return Plan(
        case_name=case.name,
        inputs=(Input("case", "case.toml", "0" * 64),),
        seed=1,
        model=ur_model("ur3"),
        T_base_ct=T,
        expected_target_error_mm=0.5,
        theta=0.3,
        beta=0.2,
        entry_ct=case.target_ct + 100.0 * outward_ct,
        target_ct=case.target_ct,
        outward_ct=outward_ct,
        roll=0.0,
        standoff_mm=STANDOFF_MM,
        needle_length_mm=case.needle.length_mm,
        approach=Trajectory(np.zeros(1), q[:1]),
        insertion=evenly((depth - depth[0]) / 2.0, q),
        clearance_mm={"approach": 20.0, "insertion": 10.0, "needle": 5.0},
        warnings=(),
    )
