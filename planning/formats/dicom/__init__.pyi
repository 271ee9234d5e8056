from .choose_series import SeriesFiles as SeriesFiles, choose_series as choose_series
from .ct_series import CtSeries as CtSeries, parse_series as parse_series, read_series as read_series
from .recognise import DicomFile as DicomFile, list_folder as list_folder, recognise as recognise
from .storage import Kind as Kind, is_dicom as is_dicom, is_series as is_series
