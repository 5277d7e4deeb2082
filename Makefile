# Everything a person or a machine does with the project. Needs Rust, Python 3.10 or newer and a C toolchain.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WHEELS := target/wheels
# The environment of the tests, whose wheel is built for building fast.
TEST_BIN := $(VENV)/tests/bin
TEST_WHEELS := target/test-wheels
DIST := target/dist
# What `make dist` builds in, and the tools that only it needs.
DIST_SOURCE := target/dist-source
DIST_TOOLS := target/dist-tools
OUT ?= out/demo
DEMO_CAPTURE := examples/tabletop-mini
DEMO_LABEL := red mug

# Tools of the build; versions move only on purpose.
MATURIN := maturin==1.16.0
PYTEST := pytest==9.2.0
RUFF := ruff==0.17.5
# Makes the site of the pages.
MDBOOK := 0.5.4
# A C compiler that links against the symbols of any glibc; the machine's own takes those of its own.
ZIG := ziglang==0.17.1
# Licences and the SBOM of what is inside the wheels.
CARGO_ABOUT := cargo-about@0.9.3
CARGO_CYCLONEDX := cargo-cyclonedx@0.5.9
# The USD of the tests; any since 26.3 will do, see pyproject.toml.
USD := usd-core==26.11
# Its library runs the models of tests of cif-vision; nothing else of it is needed (17 MB).
ONNXRUNTIME := onnxruntime==1.23.2

# Tools that read what we write, each in an environment of its own: their versions of USD or Python differ from ours.
MUJOCO := mujoco[usd]==4.0.0
NEWTON := newton==1.8.0 newton-usd-schemas==0.6.0 warp-lang==1.19.0 usd-core==26.8 scipy numpy
VALIDATOR := omniverse-asset-validator==1.18.0 usd-core==26.8
SIMREADY := simready-foundation-tier-core==2026.8.0 usd-core==26.8
OPENJD := openjd-cli==0.8.0
PYCOLMAP := pycolmap==4.2.1
# Drives the browser that is installed; Pillow reads its pictures.
PLAYWRIGHT := playwright==1.65.2 pillow numpy
BLENDERS := bpy==4.5.15/python3.11 bpy==5.0.1/python3.11 bpy==5.2.3/python3.13 bpy==5.3.0/python3.13

# One interpreter for every build, or PyO3 is built again.
export PYO3_PYTHON := $(abspath $(BIN)/python)

.PHONY: help build wheel dist demo plugin stubs docs site test test-build test-wheel test-rust test-long test-python test-mujoco test-newton test-validator test-simready test-batch test-page test-blender test-capture test-dist fuzz lint lint-format lint-page format clean

help:
	@echo "make build   the command at $(BIN)/cif, from a release wheel"
	@echo "make wheel   a wheel for other machines, into $(DIST): Linux with glibc 2.28 or newer; zig is downloaded (100 MB)"
	@echo "make dist    all that is published of the last commit, into $(DIST): wheels, the Blender extension, sources, SBOM,"
	@echo "             licences, checksums; ARCHS= names machines (x86_64 aarch64); tools are downloaded and built"
	@echo "make demo    train, evaluate, export, query and render the small capture into $(OUT)"
	@echo "make plugin  the Blender extension, into out/"
	@echo "make test    all tests but the long ones, Rust and Python"
	@echo "make test-long   the long ones: fits of whole objects"
	@echo "make fuzz    damaged files for every reader, MINUTES=60 long; READER= picks one"
	@echo "make test-mujoco, test-newton, test-blender   tests with these tools, which are downloaded (75 MB, 300 MB, 1.5 GB)"
	@echo "make test-validator   NVIDIA's validator on our stages, which is downloaded (50 MB)"
	@echo "make test-simready   NVIDIA's SimReady features of our stages, which are downloaded (100 MB)"
	@echo "make test-batch  jobs of cif batch in OpenJD, which is downloaded (5 MB), and in Slurm and HyperQueue where they are there"
	@echo "make test-page   the page of cif view in an installed Chromium; Playwright is downloaded (50 MB)"
	@echo "make test-capture   tests of cif capture with pycolmap, which is downloaded (50 MB), and ffmpeg where it is there"
	@echo "make test-dist   what make dist made, in empty environments of Python 3.10, 3.11 and 3.13, and in containers"
	@echo "make stubs   docstrings of the Python module into its stub"
	@echo "make docs    the pages of docs/reference, generated from the code"
	@echo "make site    the pages of docs as a site, into target/site; mdBook is built where it is not there"
	@echo "make lint    formatting and lints, as in CI"
	@echo "make lint-page   types of the page's script; needs node, TypeScript is downloaded"
	@echo "make format  put the formatting right"

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.10 or newer is needed; set PYTHON=" if sys.version_info < (3, 10) else 0)'
	$(PYTHON) -m venv $(VENV)

# Stamps hold the pinned version, so that a new pin installs anew.
$(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF): | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $(MATURIN) $(PYTEST) $(RUFF)
	@rm -f $(VENV)/.tools-*
	@touch "$@"

# Builds of before were installed as cif, a name that belongs to another project.
build: $(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF)
	@rm -rf $(WHEELS)
	$(BIN)/maturin build --release --interpreter $(BIN)/python --out $(WHEELS)
	@$(BIN)/python -m pip uninstall -qq --yes cif
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$$(echo $(WHEELS)/*.whl)[usd]"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --force-reinstall --no-deps $(WHEELS)/*.whl
	@echo "built: $(BIN)/cif"

wheel: $(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(ZIG)"
	@rm -rf $(DIST)
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/maturin build --release --zig --compatibility manylinux_2_28 \
		--interpreter $(BIN)/python --out $(DIST)
	@echo "built: $$(echo $(DIST)/*.whl)"

# Built from source, because that is the form in which their authors publish them on crates.io.
$(DIST_TOOLS)/.tools-$(CARGO_ABOUT)-$(CARGO_CYCLONEDX):
	cargo install --locked --root $(DIST_TOOLS) --features cli $(CARGO_ABOUT)
	cargo install --locked --root $(DIST_TOOLS) $(CARGO_CYCLONEDX)
	@rm -f $(DIST_TOOLS)/.tools-*
	@touch "$@"

ARCHS ?=
dist: $(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF) $(DIST_TOOLS)/.tools-$(CARGO_ABOUT)-$(CARGO_CYCLONEDX)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(ZIG)"
	ARCHS="$(ARCHS)" PATH="$(abspath $(BIN)):$(abspath $(DIST_TOOLS)/bin):$$PATH" \
		.ci/release/dist.sh $(DIST) $(DIST_SOURCE)

demo: build
	@mkdir -p $(OUT)
	$(BIN)/cif info $(DEMO_CAPTURE)
	$(BIN)/cif train $(DEMO_CAPTURE) -o $(OUT)/scene.cif --preset draft --force
	$(BIN)/cif eval $(OUT)/scene.cif $(DEMO_CAPTURE) --json $(OUT)/metrics.json --images $(OUT)/comparison --force
	$(BIN)/cif export $(OUT)/scene.cif --usd $(OUT)/out.usda --check --capture $(DEMO_CAPTURE) --force
	$(BIN)/cif query $(OUT)/out.usda --label "$(DEMO_LABEL)" --time 36
	$(BIN)/cif render $(OUT)/scene.cif --capture $(DEMO_CAPTURE) --split val --what rgb,instance-color,depth-color -o $(OUT)/views --force
	$(BIN)/cif export $(OUT)/scene.cif --html $(OUT)/scene.html --force
	@echo
	@echo "$(OUT)/scene.html   the scene to look at: open it in a browser; or: $(BIN)/cif view $(OUT)/scene.cif --capture $(DEMO_CAPTURE)"
	@echo "$(OUT)/scene.cif    the trained scene"
	@echo "$(OUT)/out.usda     the stage: one prim per object; try: $(BIN)/cif query $(OUT)/out.usda --label '*'"
	@echo "$(OUT)/metrics.json how good it is"
	@echo "$(OUT)/comparison/  truth, render, instance map, error and depth side by side"
	@echo "$(OUT)/views/       the views that were held out"

plugin:
	$(PYTHON) plugin/blender/build.py out

# CIF_TEST_GPU says what tests do with a GPU: auto (the default) takes what Vulkan, Metal or Direct3D 12 offers, software
# such as Mesa's lavapipe too, off skips them, require fails without one.
# CIF_TEST_ONNX says the same of ONNX Runtime, which is there.
export CIF_TEST_ONNX ?= require
test: test-rust test-python

# `make test` builds the tests before the wheel, for which little is left then: both processors have work to the end, as
# libraries are built beside the tests of others.
TEST_FEATURES := --features cif-usd/python,cif-vision/onnx
test-build: $(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF)
	cargo test --locked --no-run $(TEST_FEATURES)
ifneq ($(filter test,$(MAKECMDGOALS)),)
test-wheel: test-build
endif

# In the profile and with the features of the Rust tests, so that both share their libraries: CONTRIBUTING tells more.
test-wheel: $(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF)
	@rm -rf $(TEST_WHEELS)
	$(BIN)/maturin build --profile dev --interpreter $(BIN)/python --out $(TEST_WHEELS)
	test -x $(TEST_BIN)/python || $(PYTHON) -m venv $(VENV)/tests
	@$(TEST_BIN)/python -m pip uninstall -qq --yes cif
	$(TEST_BIN)/python -m pip install --quiet --disable-pip-version-check $(PYTEST) $(USD) "$$(echo $(TEST_WHEELS)/*.whl)[usd]"
	$(TEST_BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps $(ONNXRUNTIME)
	$(TEST_BIN)/python -m pip install --quiet --disable-pip-version-check --force-reinstall --no-deps $(TEST_WHEELS)/*.whl

# What cif-usd writes and reads is tested in a Python that has usd-core. Long tests are whole fits of objects and runs that
# others cover in part; `make test-long` runs them.
test-long: SELECTION := -- --ignored
# The tests that compare docs/reference with the code write it instead.
docs: SELECTION := --test across reference::
docs: export CIF_WRITE_DOCS := 1
test-rust test-long docs: test-wheel
	PYTHONPATH=$$($(TEST_BIN)/python -c 'import sysconfig; print(sysconfig.get_path("platlib"))') \
	LD_LIBRARY_PATH=$$($(TEST_BIN)/python -c 'import sysconfig; print(sysconfig.get_config_var("LIBDIR"))') \
	cargo test --locked --no-fail-fast $(TEST_FEATURES) $(SELECTION)

test-python: test-wheel
	$(TEST_BIN)/python -m pytest

# Runs on with random seeds; failing inputs are kept in target/tmp/fuzz-failures.
MINUTES ?= 10
READER ?=
fuzz:
	CIF_FUZZ_MINUTES=$(MINUTES) CIF_FUZZ_READER=$(READER) \
	cargo test --locked --test fuzz_readers readers -- --nocapture

# What MuJoCo makes of our files; then ours beside the USD that MuJoCo brings, 25.11.
OLD_USD_TESTS := $(addprefix tests/python/test_,stage.py query.py round_trip.py files.py)
test-mujoco: test-wheel
	test -x $(VENV)/mujoco/bin/python || $(PYTHON) -m venv $(VENV)/mujoco
	@$(VENV)/mujoco/bin/python -m pip uninstall -qq --yes cif
	$(VENV)/mujoco/bin/python -m pip install --quiet --disable-pip-version-check "$(MUJOCO)" $(PYTEST) $(TEST_WHEELS)/*.whl
	$(VENV)/mujoco/bin/python -m pip install --quiet --disable-pip-version-check --force-reinstall --no-deps $(TEST_WHEELS)/*.whl
	CIF_TEST_MUJOCO=$(VENV)/mujoco/bin/python $(TEST_BIN)/python -m pytest tests/python/test_mujoco.py
	$(VENV)/mujoco/bin/python -m pytest $(OLD_USD_TESTS)

# What Newton makes of our files, then the example that simulates with it.
test-newton: test-wheel
	test -x $(VENV)/newton/bin/python || $(PYTHON) -m venv $(VENV)/newton
	$(VENV)/newton/bin/python -m pip install --quiet --disable-pip-version-check $(NEWTON) $(PYTEST)
	CIF_TEST_NEWTON=$(VENV)/newton/bin/python $(TEST_BIN)/python -m pytest tests/python/test_newton.py
	$(VENV)/newton/bin/python -m pytest --noconftest tests/python/test_simulate.py

test-validator: test-wheel
	test -x $(VENV)/validator/bin/python || $(PYTHON) -m venv $(VENV)/validator
	$(VENV)/validator/bin/python -m pip install --quiet --disable-pip-version-check $(VALIDATOR)
	CIF_TEST_VALIDATOR=$(VENV)/validator/bin/python $(TEST_BIN)/python -m pytest tests/python/test_validator.py

test-simready: test-wheel
	test -x $(VENV)/simready/bin/python || $(PYTHON) -m venv $(VENV)/simready
	$(VENV)/simready/bin/python -m pip install --quiet --disable-pip-version-check $(SIMREADY)
	CIF_TEST_SIMREADY=$(VENV)/simready/bin/python $(TEST_BIN)/python -m pytest tests/python/test_simready.py

# Jobs of cif batch in OpenJD, and in Slurm and HyperQueue where these are installed.
test-batch: test-wheel
	test -x $(VENV)/openjd/bin/python || $(PYTHON) -m venv $(VENV)/openjd
	$(VENV)/openjd/bin/python -m pip install --quiet --disable-pip-version-check $(OPENJD)
	CIF_TEST_OPENJD=$(abspath $(VENV)/openjd/bin/openjd) $(TEST_BIN)/python -m pytest tests/python/test_batch.py

# CIF_TEST_CHROMIUM names the browser, else it is searched for on the PATH; CIF_TEST_PAGE=require fails without one.
test-page: test-wheel
	test -x $(VENV)/page/bin/python || $(PYTHON) -m venv $(VENV)/page
	$(VENV)/page/bin/python -m pip install --quiet --disable-pip-version-check $(PLAYWRIGHT) $(PYTEST) $(USD) $(TEST_WHEELS)/*.whl
	$(VENV)/page/bin/python -m pip install --quiet --disable-pip-version-check --force-reinstall --no-deps $(TEST_WHEELS)/*.whl
	$(VENV)/page/bin/python -m pytest --noconftest tests/python/test_page.py

test-capture:
	test -x $(VENV)/capture/bin/python || $(PYTHON) -m venv $(VENV)/capture
	$(VENV)/capture/bin/python -m pip install --quiet --disable-pip-version-check "$(PYCOLMAP)"
	CIF_PYTHON=$(abspath $(VENV)/capture/bin/python) cargo test --locked -p cif-capture

# Versions of Blender whose Python is not there are skipped.
test-blender:
	@set -e; for each in $(BLENDERS); do \
		wheel=$${each%/*}; python=$${each#*/}; folder=$(VENV)/$${wheel%%=*}-$${wheel##*=}; \
		if ! $$python -c pass 2>/dev/null; then echo "$$wheel: skipped, because $$python is not installed"; continue; fi; \
		echo "$$wheel"; \
		test -x $$folder/bin/python || $$python -m venv $$folder; \
		$$folder/bin/python -m pip install --quiet --disable-pip-version-check $$wheel $(PYTEST); \
		$$folder/bin/python -m pytest --noconftest tests/python/test_blender_scene.py; \
	done

# Needs no build of its own. What a machine lacks is skipped, and named: Pythons, containers, Blender.
test-dist: export CIF_TEST_DIST := $(abspath $(DIST))
test-dist: $(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF)
	$(BIN)/python -m pytest --noconftest tests/python/test_dist.py

lint: lint-format
	cargo clippy --locked --workspace --all-targets -- -D warnings

# What needs no build: CI lints the Rust while it builds the tests.
lint-format: $(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF)
	cargo fmt --all --check
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# The types of the page's script, with node and TypeScript from npm.
lint-page:
	npx --yes --package typescript@5.9.3 tsc --noEmit --checkJs --strict --target es2022 --module es2022 \
		--lib es2022,dom,dom.iterable --moduleResolution bundler plugin/web/src/*.js

# mdBook is a tool of this target alone: that on the PATH is taken where it has the version.
MDBOOK_ROOT := target/mdbook-$(MDBOOK)
site:
	$(PYTHON) docs/site.py
	@if [ "$$(mdbook --version 2>/dev/null)" = "mdbook v$(MDBOOK)" ]; then mdbook build target/book; else \
		test -x $(MDBOOK_ROOT)/bin/mdbook \
			|| cargo install --quiet --locked --root $(MDBOOK_ROOT) mdbook@$(MDBOOK) || exit 1; \
		$(MDBOOK_ROOT)/bin/mdbook build target/book; \
	fi
	@echo "built: target/site/index.html"

stubs: # after make test-wheel
	$(TEST_BIN)/python crates/cif-python/stubs.py

format: $(VENV)/.tools-$(MATURIN)-$(PYTEST)-$(RUFF)
	cargo fmt --all
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf target out $(VENV)
