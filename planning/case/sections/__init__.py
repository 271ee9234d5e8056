"""What the tables of a case become: settings in mm and radians, in the CT's frame."""
