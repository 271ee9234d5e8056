from .moveit_files import MOVEIT as MOVEIT, moveit_files as moveit_files, moveit_names as moveit_names
