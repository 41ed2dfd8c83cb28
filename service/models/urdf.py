"""The arm of a version as a URDF."""

from __future__ import annotations

from lipcore.files.urdf_writer import urdf_of_parameters
from service.foundation.errors import InvalidRequestError, problem
from service.models.export import find
from service.models.loaded import LoadedModels

MEDIA_TYPE = "application/xml"
EXAMPLE = """<?xml version="1.0"?>
<robot name="arm-v2" xmlns:drake="http://drake.mit.edu">
  <link name="base" />
  <joint name="joint1" type="revolute">
    <origin xyz="0.0 0.0 0.333" rpy="0.0 0.0 0.0" />
    <parent link="base" />
    <child link="joint1_link" />
    <axis xyz="0.0 0.0 1.0" />
    <limit lower="-2.1" upper="2.3" velocity="1.4" effort="1900.0" />
    <dynamics damping="0.12" friction="0.41" />
  </joint>
  <link name="joint1_link">
    <inertial>
      <origin xyz="0.0 -0.02 -0.05" rpy="0.0 0.0 0.0" />
      <mass value="2.9" />
      <inertia ixx="0.02" ixy="0.0" ixz="0.0" iyy="0.02" iyz="0.0" izz="0.01" />
    </inertial>
  </link>
</robot>
"""


def write(loaded: LoadedModels, model: str, version: int | None, alias: str | None) -> tuple[str, str]:
    """The name of a file and the URDF that belongs in it, of the version that serves where none is named.

    Raise NotFoundError, InvalidRequestError for both a version and an alias, and for a version without an arm.
    """
    row = find(loaded, model, version, alias)
    name, manifest = f"{row.model}-v{row.version}", row.manifest
    try:
        text = urdf_of_parameters(
            manifest.get("parameters", {}), manifest["joint_names"], manifest["training_range"], name
        )
    except ValueError as error:
        item = problem("version", row.version, "a version with rigid bodies that holds where its joints lie")
        message = f"version {row.version} of model {row.model!r} cannot be written as a URDF: {error}"
        raise InvalidRequestError(message, [item]) from error
    return f"{name}.urdf", text
