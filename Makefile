# Short names for setup.sh, which works where make is not installed.

.PHONY: setup run quick test doctor lock

setup:
	bash setup.sh

run:
	bash setup.sh run

quick:
	bash setup.sh quick

test:
	bash setup.sh test

doctor: setup
	.venv/bin/python -m pipeline doctor

# pynput and evdev are left out: only lerobot's keyboard teleoperation needs them, and evdev takes a compiler.
lock: setup
	UV_CUSTOM_COMPILE_COMMAND="make lock" .venv/bin/uv pip compile --quiet --python-version 3.11 \
		pyproject.toml --group dev --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate \
		--no-emit-package pynput --no-emit-package evdev -o requirements.lock
