from .slicer_files import Drawn as Drawn, SlicerFiles as SlicerFiles, slicer_files as slicer_files
