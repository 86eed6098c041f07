"""What setup.sh has Numba compile is all that a run would have to."""

import importlib
import pkgutil

import pipeline
from pipeline.jit import DISPATCHERS
from pipeline.validation.loops import compile_all


def test_every_loop_is_compiled_once_and_for_all() -> None:
    for module in pkgutil.walk_packages(pipeline.__path__, "pipeline."):
        apart = module.name.endswith(".lerobot_eval")  # which needs lerobot 0.6
        if not module.name.rpartition(".")[2].startswith("_") and ".templates." not in module.name and not apart:
            importlib.import_module(module.name)
    compile_all()
    assert len(DISPATCHERS) >= 5
    # One kind of arguments each: another one would be compiled anew.
    assert {name: len(dispatcher().signatures) for name, dispatcher in DISPATCHERS.items()} == dict.fromkeys(
        DISPATCHERS, 1
    )
