# make demo | test | check | wide | slow | nightly | bags | bench | faults | mutants | tables | gallery | real | docs | clean      (PYTHON=python3.12 make ... for another)
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# Bytecode is kept, as users have it: a command then starts in half the time.
unexport PYTHONDONTWRITEBYTECODE

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# uv is twice as fast as pip, but knows neither the system's certificates nor pip's index by itself.
export UV_SYSTEM_CERTS ?= 1
ifdef PIP_INDEX_URL
export UV_DEFAULT_INDEX ?= $(PIP_INDEX_URL)
endif
# Nodes under test talk to this machine only.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST

.PHONY: venv libraries demo test plain nodes wide check lint types slow nightly bags bench faults mutants tables gallery real docs maintainer clean

venv: $(STAMP)

LIBRARIES := -e '.[ros,dev,workbench,fleet,camera,docs]'

# $(call install,WHAT): by uv, or, where it cannot reach the index, by pip.
define install
$(BIN)/uv pip install -q -p $(BIN)/python $(1) 2>/dev/null \
	 || $(BIN)/python -m pip install -qq $(1)
endef

# Wheels of messages: those of this package, and, for the tests only, those of which the index has
# none: the action of robot controllers, TF, and the inverse kinematics of MoveIt.
WHEELS := $(addprefix $(VENV)/wheels/,parallel_cal_msgs control_msgs tf2_msgs moveit_msgs)
sources = $(wildcard $(1)/*.* $(1)/*/*.*)

# The wheels are built at once, while the libraries are installed; of two installations in one
# environment, uv lets one wait. A changed list of libraries leaves the wheels, which take longest.
$(STAMP): $(VENV)/.created setup.cfg pyproject.toml \
  $(foreach folder,msg_defs test/control_msgs test/tf2_msgs test/moveit_msgs,$(call sources,$(folder)))
	@echo "installing the libraries and building the messages of ROS 2 (some minutes)"
	@$(MAKE) -s --no-print-directory -j 5 libraries $(WHEELS)
	@$(call install,--force-reinstall --no-deps $(WHEELS:%=%/*.whl))
	@$(call install,$(WHEELS:%=%/*.whl))
	@touch $@

libraries:
	@$(call install,$(LIBRARIES))

# $(call wheel,SOURCES): into the folder of the target, which is there only when the wheel is.
define wheel
rm -rf $@ $@.part && { $(BIN)/uv build -q --wheel -p $(BIN)/python -o $@.part $(1) 2>/dev/null \
	 || $(BIN)/python -m pip wheel -qq --no-deps -w $@.part $(1); } && mv $@.part $@
endef

$(VENV)/wheels/parallel_cal_msgs: $(call sources,msg_defs)
	@$(call wheel,./msg_defs)

# They are built as msg_defs is, from the same list of tools.
$(VENV)/wheels/control_msgs: NEEDED := trajectory-msgs
$(VENV)/wheels/tf2_msgs: NEEDED := geometry-msgs
$(VENV)/wheels/moveit_msgs: NEEDED := sensor-msgs
$(VENV)/wheels/control_msgs: $(call sources,test/control_msgs)
$(VENV)/wheels/tf2_msgs: $(call sources,test/tf2_msgs)
$(VENV)/wheels/moveit_msgs: $(call sources,test/moveit_msgs)
$(filter-out %/parallel_cal_msgs,$(WHEELS)):
	@rm -rf build/$(@F) && mkdir -p build/$(@F)
	@cp -R test/$(@F)/* msg_defs/pip_build build/$(@F)
	@sed -e 's/parallel_cal_msgs/$(@F)/' -e 's/^version = .*/version = "0.0.0"/' \
	  -e 's/ros-jazzy-geometry-msgs/ros-jazzy-$(NEEDED)/' \
	  msg_defs/pyproject.toml > build/$(@F)/pyproject.toml
	@$(call wheel,./build/$(@F))

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	  { echo "Python 3.10 or newer is needed, e.g. make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq uv 2>/dev/null || true
	@touch $@

demo: $(STAMP)
	@$(BIN)/parallel-cal demo

# Every worker has a ROS domain of its own, and starts the nodes that a file shares once.
PYTEST := $(BIN)/python -m pytest -q --dist loadfile --no-loadscope-reorder

# Tests with nodes mostly wait for a robot that moves. The others run in that time, and yield to them.
plain: $(STAMP)
	@nice -n 10 $(PYTEST) -n 2 -m "$(MARKS)not ros"

# Their output follows when all of them have ended: two at once cannot be read.
nodes: $(STAMP)
	@mkdir -p build
	@$(PYTEST) -n 2 -m "$(MARKS)ros" > build/nodes.txt 2>&1; status=$$?; cat build/nodes.txt; exit $$status

# $(call together,MARKS,TARGETS): the tests with these marks, and these targets beside them.
together = $(MAKE) --no-print-directory -j 3 plain nodes $(2) MARKS='$(1)'

test: $(STAMP)
	@$(call together,not slow and not wide and )

# The same over more robots, effects and recordings, and whatever else takes its time.
wide: $(STAMP)
	@$(call together,wide and not slow and )

slow: $(STAMP)
	@$(BIN)/python -m pytest -q -m slow

# Every test there is, with the most random examples: hours.
nightly: lint
	@$(call together,,types)

# `make test` and `make wide` at once.
check: lint
	@$(call together,not slow and ,types)

lint: $(STAMP)
	@$(BIN)/ruff check -q .
	@$(BIN)/ruff format -q --check .

types: $(STAMP)
	@$(BIN)/mypy

bags: $(STAMP)
	@$(BIN)/python test/helpers/make_baselines.py
	@$(BIN)/python test/helpers/make_bags.py

bench: $(STAMP)
	@$(BIN)/parallel-cal bench

# The nodes under faults by the thousand (docs/reliability.md): 20 minutes; SHARE=0.1 for a part.
SHARE ?= 1
faults: $(STAMP)
	@$(BIN)/python -m bench.truth.faults --share $(SHARE)

# Mistakes planted in the package, one at a time: which do the nearest tests find? WORDS="journal prior"
# for some of them; half an hour for all.
mutants: $(STAMP)
	@$(BIN)/python test/project/mutants.py $(WORDS)

# The documents' tables and figures again (docs/tables.*): some minutes.
tables: $(STAMP)
	@$(call install,matplotlib)
	@$(BIN)/python -m bench.documents.tables

# What mechanisms and effects look like (docs/mechanisms.md, docs/gallery.md).
gallery: $(STAMP)
	@$(BIN)/python docs/mechanisms.py
	@$(BIN)/python docs/gallery.py

# The documentation site: build/site/index.html. A warning is an error.
docs: $(STAMP)
	@$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/site

# The real machines in real/ calibrated beside independent fits (docs/real_machines.md).
real: $(STAMP)
	@$(BIN)/python -m bench.truth.real_machines

# Who maintains a release, in every package.xml at once (CONTRIBUTING.md, Before a release):
#   make maintainer EMAIL=jane@lab.org URL=https://github.com/lab/parallel_cal
maintainer:
	@test -n "$(EMAIL)" -a -n "$(URL)" || { echo "usage: make maintainer EMAIL=... URL=..."; exit 2; }
	@sed -i -E -e '/example.org is a placeholder/d' \
	  -e 's|(<maintainer email=")[^"]*|\1$(EMAIL)|' \
	  -e 's|(<url type="website">)[^<]*|\1$(URL)|' \
	  -e 's|(<url type="repository">)[^<]*|\1$(URL).git|' \
	  -e 's|(<url type="bugtracker">)[^<]*|\1$(URL)/issues|' \
	  package.xml msg_defs/package.xml test/*_msgs/package.xml

clean:
	@rm -rf $(VENV) build install log dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
