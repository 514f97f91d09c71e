from .exceptions import InputError as InputError
from .exceptions import NoSolutionFound as NoSolutionFound
from .exceptions import NotDelivered as NotDelivered
from .exceptions import RowError as RowError
from .exceptions import RpimError as RpimError
