# demo and test create .venv and use it. The command is then .venv/bin/cdmisfa.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
INSTALLED := .venv/.installed
TESTED := .venv/.with-test
SOURCES := pyproject.toml setup.py $(wildcard cdmisfa/kernels/*.[ch] cdmisfa/kernels/b*.py) \
    $(if $(wildcard cdmisfa/kernels/*.so),,FORCE)

SANITIZED := build/sanitized
SANITIZERS := -fsanitize=address,undefined -fno-sanitize-recover=all

.PHONY: demo test suite lint bench docs images fuzz torture attacks sanitized release \
    clean install

demo: $(INSTALLED)
	$(BIN)/cdmisfa demo --jobs 2

test: lint suite

# Three processes on two cores: one of them usually waits for a camera, a viewer or a killed process.
suite: $(TESTED)
	$(BIN)/pytest -n 3 --dist loadgroup

lint: $(TESTED)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

bench: .venv/.with-bench
	$(BIN)/python -m benchmarks

# Build the site in build/site, without network access. All of it is built again: tables are made
# from the code, and Sphinx forgets the index entries of unchanged pages, which the search needs.
docs: .venv/.with-docs
	$(BIN)/sphinx-build -W -E -a -b html docs build/site

images: .venv/.with-docs
	$(BIN)/python docs/images/draw.py

fuzz: $(TESTED)
	$(BIN)/python -m tools.fuzz.guided --seconds $(or $(SECONDS),60)
	$(BIN)/python -m tools.fuzz.logs --jobs 2

torture: $(TESTED)
	$(BIN)/python -m tools.torture --seed $(or $(SEED),0) --minutes $(or $(MINUTES),30)

# Run the tests of tools/, with some cases of each kind of attack, and of the benchmarks.
attacks: $(TESTED)
	$(BIN)/pytest -n 3 --dist loadgroup tools

# Run the tests of the kernels with sanitizers: they stop at an access outside an array or an overflow.
sanitized: $(TESTED)
	CFLAGS="$(SANITIZERS)" LDFLAGS="$(SANITIZERS)" $(BIN)/python setup.py -q \
	    build --build-base $(SANITIZED) --build-lib $(SANITIZED)/lib
	LD_PRELOAD="$$(gcc -print-file-name=libasan.so)" \
	ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 \
	    $(BIN)/pytest -q -o "pythonpath=$(SANITIZED)/lib ." $(wildcard tests/test_kernels*.py) \
	    tests/test_incsfa.py tests/test_recursive_sfa.py tests/test_chunks.py

# Build the wheel and the source archive of the commit in dist/.
release: .venv/.with-release
	rm -rf dist build/release
	git clone --quiet . build/release
	$(BIN)/python -m build --outdir dist build/release
	$(BIN)/twine check --strict dist/*

install: $(INSTALLED)

# Install the product; .with-EXTRA adds an extra of pyproject.toml.
$(INSTALLED): $(SOURCES)
	@echo "installing cdmisfa and what it needs into .venv, once (about a minute)"
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e .
	touch $@

.venv/.with-%: $(SOURCES)
	@echo "installing cdmisfa with its extra $* into .venv, once (about a minute)"
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[$*]'
	touch $(INSTALLED) $@

FORCE:

clean:
	rm -rf .venv build dist cdmisfa/kernels/*.so *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find cdmisfa recorder replay tests tools benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
