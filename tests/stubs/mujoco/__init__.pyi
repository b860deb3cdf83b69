# MuJoCo's structs come from a binary module without stubs: a type checker knows nothing
# of their attributes.
from typing import Any

def __getattr__(name: str) -> Any: ...
