from .dataset import Dataset as Dataset
from .models import Measurement as Measurement
from .reading import read_data as read_data
from .record import Record as Record
from .tracker import LaserTracker as LaserTracker
from .understanding import Asked as Asked
