# Short names for setup.sh, which also works without make.

.PHONY: setup run quick test doctor site lock sbom

setup:
	bash setup.sh

run:
	bash setup.sh run

quick:
	bash setup.sh quick

test:
	bash setup.sh test

doctor: setup
	.venv/bin/python -m pipeline doctor configs/starter.yaml

# The documentation in build/site/index.html, with search.
site: setup
	.venv/bin/python -m mkdocs build --strict

# pynput and evdev are left out: only lerobot's keyboard teleoperation needs them, and evdev requires a compiler.
lock: setup
	UV_CUSTOM_COMPILE_COMMAND="make lock" .venv/bin/uv pip compile --quiet --universal --python-version 3.11 \
		pyproject.toml --group dev --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate \
		--no-emit-package pynput --no-emit-package evdev -o requirements.lock

# Every installed package with version and licence, without its links. The tool runs in a separate environment.
sbom: setup
	.venv/bin/uv tool run --from cyclonedx-bom==7.5.0 cyclonedx-py environment --output-reproducible --of JSON \
		--pyproject pyproject.toml -o sbom.json .venv
	.venv/bin/python -c "import json; bill = json.load(open('sbom.json')); \
		[part.pop('externalReferences', None) for part in bill['components']]; bill['metadata'].pop('tools'); \
		json.dump(bill, open('sbom.json', 'w'), indent=1, sort_keys=True)"
