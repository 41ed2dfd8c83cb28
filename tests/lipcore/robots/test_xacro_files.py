"""Robots in xacro: macros, included files and packages of a zip; nothing outside the upload is read."""

import zipfile

import pytest

from lipcore.robots.urdf import describe
from lipcore.robots.urdf_text import UrdfError
from lipcore.robots.xacro_files import expand_xacro, unpack_description

pytest.importorskip("xacro")
XMLNS = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
LINK = """<xacro:macro name="link" params="name mass">
  <link name="${name}"><inertial><origin xyz="0 0 ${length / 2}"/><mass value="${mass}"/>
  <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link></xacro:macro>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><origin xyz="0 0 ${{length}}"/>
<axis xyz="0 1 0"/><limit lower="-${{radians(90)}}" upper="2" effort="10" velocity="3"/></joint>"""
ARM = f"""<xacro:property name="length" value="0.4"/>INCLUDE<link name="base"/>
<xacro:link name="upper" mass="${{2 * 3}}"/><xacro:link name="lower" mass="2"/>
{JOINT.format("shoulder", "base", "upper")}{JOINT.format("elbow", "upper", "lower")}"""


def robot(body):
    return f'<robot name="arm" {XMLNS}>{body}</robot>'


def expand(folder, files, main="arm.urdf.xacro"):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return expand_xacro(folder / main, folder, {})


def check(urdf):
    described = describe(urdf)
    assert [each.name for each in described.joints] == ["shoulder", "elbow"]
    assert 'value="6"' in urdf
    assert "1.5707963" in urdf
    assert "xacro:" not in urdf.replace(XMLNS, "")


def test_macros_and_expressions_of_one_file_are_expanded(tmp_path):
    check(expand(tmp_path, {"arm.urdf.xacro": robot(ARM.replace("INCLUDE", LINK))}))


@pytest.mark.parametrize("include", ["inc/link.xacro", "$(find arm_description)/inc/link.xacro"])
def test_included_files_of_a_zip_are_found(tmp_path, include):
    main = robot(ARM.replace("INCLUDE", f'<xacro:include filename="{include}"/>'))
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("ws/arm_description/arm.urdf.xacro", main)
        archive.writestr("ws/arm_description/inc/link.xacro", robot(LINK))
        archive.writestr("ws/arm_description/package.xml", "<package/>")
        archive.writestr("ws/arm_description/meshes/a.stl", b"mesh")
    folder = tmp_path / "files"
    folder.mkdir()
    file = unpack_description(tmp_path / "a.zip", folder, 1 << 20)
    assert file.name == "arm.urdf.xacro"
    assert not list(folder.rglob("*.stl"))
    check(expand_xacro(file, folder, {}))


def test_arguments_are_set_and_named_if_they_are_wrong(tmp_path):
    """As in the description of UR's arms: a folder of numbers for each type."""
    yaml = "<xacro:property name='numbers' value=\"${xacro.load_yaml('config/$(arg ur_type)/mass.yaml')}\"/>"
    body = ARM.replace("INCLUDE", LINK + yaml + '<xacro:arg name="ur_type" default="ur5x"/>')
    files = {
        "arm.urdf.xacro": robot(body.replace("${2 * 3}", "${numbers['upper']}")),
        "config/ur5e/mass.yaml": "upper: 6",
    }
    with pytest.raises(UrdfError, match="Its arguments are ur_type: set xacro=ur_type="):
        expand(tmp_path, files)
    check(expand_xacro(tmp_path / "arm.urdf.xacro", tmp_path, {"ur_type": "ur5e"}))


SECRET = '<xacro:include filename="../secret.xacro"/>'
HOSTILE = {
    "outside": (SECRET, "which is not in the upload"),
    "absolute": ('<xacro:include filename="/etc/passwd"/>', "which is not in the upload"),
    "yaml": ("""<link name="${xacro.load_yaml('/etc/passwd')}"/>""", "which is not in the upload"),
    "package": ('<xacro:include filename="$(find ur_description)/a.xacro"/>', "Upload a zip with the folder ur_desc"),
    "eval": ('<xacro:property name="p" value="$(eval 1 + 1)"/><link name="${p}"/>', "which are not evaluated"),
    "environment": ('<xacro:property name="p" value="$(env HOME)"/><link name="${p}"/>', "which are not evaluated"),
    "python": ("""<link name="${().__class__.__bases__}"/>""", "xacro cannot expand arm.urdf.xacro"),
    "import": ("""<link name="${__import__('os').getcwd()}"/>""", "xacro cannot expand arm.urdf.xacro"),
    "undefined": ('<xacro:no_such_macro/><link name="${unknown}"/>', "xacro cannot expand arm.urdf.xacro"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_nothing_outside_the_upload_is_read_or_evaluated(tmp_path, kind):
    body, message = HOSTILE[kind]
    folder = tmp_path / "files"
    folder.mkdir()
    (tmp_path / "secret.xacro").write_text(robot(LINK))
    with pytest.raises(UrdfError, match=message):
        expand(folder, {"arm.urdf.xacro": robot(body)})


def test_entities_are_refused(tmp_path):
    entities = "<!DOCTYPE r [<!ENTITY a 'aaaa'>]>" + robot("<link name='&a;'/>")
    with pytest.raises(UrdfError, match="document type"):
        expand(tmp_path, {"arm.urdf.xacro": entities})


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"a.xacro": robot(""), "b.xacro": robot("")}, "it has: a.xacro, b.xacro"),
        ({"readme.txt": "no robot"}, "it has: none"),
        ({"a.xacro": robot("x" * 2000)}, "bytes"),
    ],
)
def test_zip_without_one_robot_is_refused(tmp_path, files, message):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    (tmp_path / "files").mkdir()
    with pytest.raises(UrdfError, match=message):
        unpack_description(tmp_path / "a.zip", tmp_path / "files", 1000)
