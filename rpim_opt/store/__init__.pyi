from .instances import Instance as Instance
from .instances import load as load
from .result_file import load_result as load_result
from .result_file import save_result as save_result
from .starting import new_problem as new_problem
