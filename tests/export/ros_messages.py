"""Messages of ROS 2 that rosbags does not define: names and types of their fields, as their repositories state them.

Read from (repository, file, commit):

- moveit/moveit_msgs: msg/PlanningScene.msg 313bd6a6447c, msg/CollisionObject.msg b75d7b5ee33d,
  msg/PlanningSceneWorld.msg 733a4135053c, msg/AttachedCollisionObject.msg and msg/AllowedCollisionMatrix.msg
  de067a1d928c, msg/AllowedCollisionEntry.msg 215e01f9c8d1, msg/RobotState.msg 3a9e0edc9f50 and, for its ``is_diff``,
  CHANGELOG.rst 0.5.2 at 0063f3f355b1
- ros-controls/control_msgs: control_msgs/action/FollowJointTrajectory.action 800dd36e6366 (release 3 and later: Humble
  and Jazzy), control_msgs/msg/JointTolerance.msg 220a84bb0210 (later ones add ``effort``)
- PickNikRobotics/octomap_msgs: msg/OctomapWithPose.msg 7dd9a3028d98
- ros2/common_interfaces: shape_msgs/msg/SolidPrimitive.msg e564e5f322b5, which rosbags has

What nothing here writes (LinkPadding, LinkScale, ObjectColor, ObjectType, Octomap, JointComponentTolerance) is from
code that ROS generated.
"""

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MESSAGES = {
    "moveit_msgs/msg/PlanningScene": (
        *("string name", "RobotState robot_state", "string robot_model_name"),
        *("geometry_msgs/TransformStamped[] fixed_frame_transforms", "AllowedCollisionMatrix allowed_collision_matrix"),
        *("LinkPadding[] link_padding", "LinkScale[] link_scale", "ObjectColor[] object_colors"),
        *("PlanningSceneWorld world", "bool is_diff"),
    ),
    "moveit_msgs/msg/RobotState": (
        *("sensor_msgs/JointState joint_state", "sensor_msgs/MultiDOFJointState multi_dof_joint_state"),
        *("AttachedCollisionObject[] attached_collision_objects", "bool is_diff"),
    ),
    "moveit_msgs/msg/PlanningSceneWorld": (
        "CollisionObject[] collision_objects",
        "octomap_msgs/OctomapWithPose octomap",
    ),
    "moveit_msgs/msg/AttachedCollisionObject": (
        *("string link_name", "CollisionObject object", "string[] touch_links"),
        *("trajectory_msgs/JointTrajectory detach_posture", "float64 weight"),
    ),
    "moveit_msgs/msg/CollisionObject": (
        *("std_msgs/Header header", "geometry_msgs/Pose pose", "string id", "object_recognition_msgs/ObjectType type"),
        *("shape_msgs/SolidPrimitive[] primitives", "geometry_msgs/Pose[] primitive_poses"),
        *("shape_msgs/Mesh[] meshes", "geometry_msgs/Pose[] mesh_poses"),
        *("shape_msgs/Plane[] planes", "geometry_msgs/Pose[] plane_poses"),
        *("string[] subframe_names", "geometry_msgs/Pose[] subframe_poses"),
        *("byte ADD=0", "byte REMOVE=1", "byte APPEND=2", "byte MOVE=3", "byte operation"),
    ),
    "moveit_msgs/msg/AllowedCollisionMatrix": (
        *("string[] entry_names", "AllowedCollisionEntry[] entry_values"),
        *("string[] default_entry_names", "bool[] default_entry_values"),
    ),
    "moveit_msgs/msg/AllowedCollisionEntry": ("bool[] enabled",),
    "moveit_msgs/msg/LinkPadding": ("string link_name", "float64 padding"),
    "moveit_msgs/msg/LinkScale": ("string link_name", "float64 scale"),
    "moveit_msgs/msg/ObjectColor": ("string id", "std_msgs/ColorRGBA color"),
    "object_recognition_msgs/msg/ObjectType": ("string key", "string db"),
    "octomap_msgs/msg/OctomapWithPose": (
        *("std_msgs/Header header", "geometry_msgs/Pose origin"),
        "octomap_msgs/Octomap octomap",
    ),
    "octomap_msgs/msg/Octomap": (
        *("std_msgs/Header header", "bool binary", "string id", "float64 resolution", "int8[] data"),
    ),
    "control_msgs/msg/FollowJointTrajectoryGoal": (
        *("trajectory_msgs/JointTrajectory trajectory", "trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory"),
        *("JointTolerance[] path_tolerance", "JointComponentTolerance[] component_path_tolerance"),
        *("JointTolerance[] goal_tolerance", "JointComponentTolerance[] component_goal_tolerance"),
        "builtin_interfaces/Duration goal_time_tolerance",
    ),
    "control_msgs/msg/JointTolerance": (
        "string name",
        *("float64 position", "float64 velocity", "float64 acceleration"),
    ),
    "control_msgs/msg/JointComponentTolerance": (
        *("string joint_name", "uint16 component"),
        *("float64 position", "float64 velocity", "float64 acceleration"),
    ),
}
"""Message to its fields; the action's goal stands as a message of its package."""


def type_store(store=Stores.ROS2_HUMBLE):
    made = get_typestore(store)
    types = {}
    for name, fields in MESSAGES.items():
        types.update(get_types_from_msg("\n".join(fields) + "\n", name))
    made.register(types)
    return made
