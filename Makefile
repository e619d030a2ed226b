.PHONY: demo test suite quick lint docs bench versions clean
.DELETE_ON_ERROR:

# Python keeps the bytecode of what is imported, whatever the environment says: nothing else is
# compiled when packages are installed, and without it each process that tests start takes 2.1 s of
# CPU to begin in place of 0.8.
export PYTHONDONTWRITEBYTECODE :=

bin := .venv/bin
# A worker that dies is a failed test and the end: pytest-xdist would wait for it for ever.
# BLAS's threads wait for each other by spinning, and each core has a worker of its own: the tests of
# batch fits take 20 s of CPU in place of 55 to 64 beside another program.
# glibc gives memory back to the system and takes it again, a page fault each 4 kB: 2.8 million in
# test_reconstruction.py. Told to keep what it has, it makes 0.4 million, and the tests take a tenth
# less of CPU. Other systems ignore the variables.
suite := MALLOC_TRIM_THRESHOLD_=1073741824 MALLOC_MMAP_THRESHOLD_=1073741824 \
    MALLOC_TOP_PAD_=67108864 OPENBLAS_NUM_THREADS=1 \
    $(bin)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder --max-worker-restart 0
# Python compiles the few modules that are imported; all of them take half of the installation.
pip := $(bin)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt
# uv takes a quarter of pip's time. Where it is not to be had, or finds no index (it does not read
# pip's configuration), pip does the work.
define install
	@$(pip) uv 2>/dev/null && $(bin)/uv pip install --quiet --python $(bin)/python \
	    -c constraints.txt -e '.[$(extras)]' 2>/dev/null || $(pip) -e '.[$(extras)]'
endef

demo: .venv/demo.stamp
	$(bin)/jaxevent demo

# Lint, 9 s of CPU that nearly all go to the types, is done beside the tests.
test: .venv/test.stamp
	@$(MAKE) --no-print-directory -j 2 suite lint

suite: .venv/test.stamp
	$(suite) $(chosen)

# For the edit loop: none of the tests that take long.
quick: .venv/test.stamp
	@$(MAKE) --no-print-directory -j 2 suite lint chosen='-m "not slow"'

lint: .venv/test.stamp
	$(bin)/ruff check
	$(bin)/ruff format --check
	$(bin)/lint-imports --no-cache
	$(bin)/ty check --python $(bin)/python

docs: .venv/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(bin)/mkdocs build --strict

bench: .venv/bench.stamp
	$(bin)/python experiments/bench.py

# Each Python that this machine has, with the oldest and with the newest dependencies; minutes each.
versions: .venv/made.stamp
	@$(pip) uv
	$(bin)/python experiments/versions.py

clean:
	rm -rf .venv build dist site jaxevent-demo .pytest_cache .hypothesis .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/demo.stamp: extras := plot,video
.venv/test.stamp: extras := test
.venv/docs.stamp: extras := docs
.venv/bench.stamp: extras := bench,plot,video
.venv/demo.stamp .venv/test.stamp .venv/docs.stamp .venv/bench.stamp: \
    pyproject.toml constraints.txt | .venv/made.stamp
	$(install)
	@touch $@

# A name on the PATH may not run (a version manager's shim) or may lack venv: take one that works.
.venv/made.stamp:
	@for python in $(PYTHON) python3.13 python3.12 python3.11 python3; do \
	    if $$python -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' \
	        >/dev/null 2>&1; \
	    then \
	        echo "making .venv with $$($$python --version)"; \
	        $$python -m venv .venv && touch $@; \
	        exit; \
	    fi; \
	done; \
	echo "No working Python 3.11 or newer with venv was found: install one, or name it with" \
	    "make PYTHON=/path/to/python3" >&2; \
	exit 1
