# Every target sets up .venv when a lock file, pyproject.toml or services/package.py (which the installation copies) is
# newer, and prints nothing when it is ready.
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
PORT ?= 8000
# As services/cli.py sets it for every command: the products are small, and waiting threads of BLAS take the cores of other processes.
export OPENBLAS_NUM_THREADS := 1
# Hundreds of processes of the tests import the same modules: their bytecode is kept even where the environment forbids it.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help run run-emulated pi gate test test-ports test-faults test-browser test-long test-paper test-hard test-systemd test-appliance test-arm64 test-boot test-other test-golden test-exam test-light test-archive test-mutants page-pictures bundle browser buses strace stress-ng lint release bench bench-archive bench-attacks bench-budget bench-data bench-deadline bench-elements bench-element-refraction bench-frames bench-kills bench-lesions bench-store bench-montage bench-psf bench-retinas bench-refraction bench-sides bench-wifi bench-page bench-peers bench-pi channel readme results effects frontier parts part-pictures test-parts site test-site lock clean

help: ## List the make targets.
	@sed -nE 's/^([a-z0-9-]+):.*## (.*)/make \1\t\2/p' Makefile | expand -t 20

# The drivers' libraries come without what they declare (av, OpenEXR, a GPL'd prctl): a raw frame needs none of it.
PI_LOCK := tests/ports/emulators/requirements.lock

# uv installs a lock file in a tenth of pip's time, and each package from its cache in every further environment.
UV := .uv-venv/bin/uv
INSTALL = $(UV) pip install --quiet --require-hashes --python
INSTALL_THIS = $(UV) pip install --quiet --no-deps --no-build-isolation --python

$(UV):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Diffuscope needs Python 3.11 or newer; set PYTHON=..."; exit 1; }
	@$(PYTHON) -m venv .uv-venv || { echo "Install the venv module first, on Debian: apt-get install python3-venv"; exit 1; }
	@.uv-venv/bin/pip install -qq --disable-pip-version-check --only-binary :all: uv==0.13.9

.venv/ready: requirements.lock $(PI_LOCK) pyproject.toml services/package.py services/__main__.py | $(UV)
	@echo "Setting up .venv (a minute, once)"
	@$(PYTHON) -m venv .venv
	@$(INSTALL) $(BIN)/python --compile-bytecode -r requirements.lock  # many processes import it at once
	@$(INSTALL) $(BIN)/python --no-deps -r $(PI_LOCK)
	@$(INSTALL_THIS) $(BIN)/python -e .
	@touch $@

# Numba keeps compiled kernels beside the sources; three parallel test processes would compile each of them three times.
.venv/kernels: device/recon/model/kernels.py device/recon/model/fused_kernels.py .venv/ready
	@$(BIN)/python -m tests.compile_kernels
	@touch $@

run: .venv/ready ## Serve the page with the simulated head; PORT=8001 for another port.
	@$(BIN)/diffuscope run --port $(PORT)

# HEAD: a head file with real drivers; DO: the words of another command, which needs no other settings than --head.
HEAD ?= tests/ports/emulators/heads/emulated.toml
DO ?= run --port $(PORT) --data out/emulated

run-emulated: .venv/ready buses ## Serve the page with real drivers over emulated buses, whose bytes are printed; DO="doctor --parts".
	@umockdev-wrapper $(BIN)/python -m tests.ports.emulators.launch $(DO) --head $(HEAD)

# Debian's drivers lie behind .venv's own packages on the path, so that NumPy stays that of the lock file; those that only
# the tests' emulators need are taken out, as they would hide Debian's.
PI_PACKAGES := python3-picamera2 python3-libcamera python3-spidev python3-smbus2 python3-libgpiod
PI_CONFIG := /boot/firmware/config.txt

pi: ## On a Raspberry Pi: install the drivers, let .venv see them, switch SPI and I2C on; then restart.
	@[ -f $(PI_CONFIG) ] || { echo "make pi is for Raspberry Pi OS of Debian 13: there is no $(PI_CONFIG) here"; exit 1; }
	@sudo apt-get update -qq
	@sudo apt-get install -y -qq --no-install-recommends $(PI_PACKAGES) python3-venv python3-dev gcc
	@$(MAKE) .venv/ready
	@$(BIN)/pip uninstall -qq -y picamera2 spidev smbus2
	@echo /usr/lib/python3/dist-packages > "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/debian.pth"
	@for line in dtparam=spi=on dtparam=i2c_arm=on dtparam=strict_gpiod; do \
		grep -qxF "$$line" $(PI_CONFIG) || echo "$$line" | sudo tee -a $(PI_CONFIG); done
	@echo i2c-dev | sudo tee /etc/modules-load.d/diffuscope-i2c.conf >/dev/null
	@sudo usermod -aG spi,i2c,gpio,video "$$(id -un)"
	@echo "Restart the computer, then: $(BIN)/diffuscope doctor"

# KiCad 9 comes from Debian 13 in a chroot of 1.5 GB, which only root can make; nothing of the tests needs it.
GATE_ROOT := out/kicad
GERBERS := F.Cu,B.Cu,F.Mask,B.Mask,F.Paste,B.Paste,F.SilkS,B.SilkS,Edge.Cuts

$(GATE_ROOT)/ready:
	@[ "$$(id -u)" = 0 ] || { echo "make gate makes a chroot, which only root can: sudo make gate"; exit 1; }
	@command -v mmdebstrap >/dev/null || { apt-get update -qq && apt-get install -y -qq mmdebstrap >/dev/null; }
	@rm -rf $(GATE_ROOT) && mkdir -p out && mmdebstrap --quiet --variant=minbase --include=kicad --aptopt='Apt::Install-Recommends "false"' \
		trixie $(GATE_ROOT) http://deb.debian.org/debian
	@touch $@

gate: $(GATE_ROOT)/ready ## Check schematic (ERC) and boards (DRC) of gate and ring with KiCad 9, write what a maker of boards needs to out/gate; needs root.
	@rm -rf $(GATE_ROOT)/gate out/gate && cp -r hardware/gate $(GATE_ROOT)/gate && mkdir -p $(GATE_ROOT)/gate/out
	@chroot $(GATE_ROOT) sh -c 'cd /gate && export HOME=/ && kicad-cli version && \
		kicad-cli sch erc --severity-all --exit-code-violations -o out/erc.rpt gate.kicad_sch && \
		kicad-cli sch export netlist -o out/gate.net gate.kicad_sch && kicad-cli sch export svg -o out gate.kicad_sch && \
		for board in gate ring; do \
			kicad-cli pcb drc --severity-all --exit-code-violations -o out/$$board-drc.rpt $$board.kicad_pcb && \
			kicad-cli pcb export gerbers -l $(GERBERS) -o out/$$board/ $$board.kicad_pcb && \
			kicad-cli pcb export drill -o out/$$board/ $$board.kicad_pcb && \
			kicad-cli pcb export pos --format csv --units mm -o out/$$board/places.csv $$board.kicad_pcb && \
			for side in top bottom; do \
				kicad-cli pcb render --side $$side -w 900 --height 640 -o out/$$board-$$side.png $$board.kicad_pcb || exit 1; \
			done || exit 1; \
		done' >$(GATE_ROOT)/log 2>&1 || { cat $(GATE_ROOT)/log $(GATE_ROOT)/gate/out/*.rpt; exit 1; }
	@cp -r $(GATE_ROOT)/gate/out out/gate && cat out/gate/*.rpt
	@[ -z "$$SUDO_UID" ] || { chown "$$SUDO_UID:$$SUDO_GID" out && chown -R "$$SUDO_UID:$$SUDO_GID" out/gate; }  # else make parts is refused

# A press on the real server, with every interruption; `make test-browser` tests whole visits and the rest of the page.
JOURNEYS := tests/browser/test_page.py
# What takes minutes of pure computing or kills processes; the rest is `make test`, which should stay below six minutes.
FAULTS := tests/hard tests/physics tests/property
# Whole calibrations, every fault of every part, interruptions, restored backups, updates, montages, every scene, and what
# starts a process for each of many cases.
INSTRUMENT_FAULTS := $(addprefix tests/journey/,test_fault_states.py test_calibration_session.py test_calibration_monitor.py test_calibration_faults.py \
	test_calibrate_command.py test_calibrations_command.py test_interrupted_press.py \
	test_accuracy_explorer.py test_backup_page.py test_shutdown.py test_upload.py \
	test_store_refusal_after_light.py test_visit_export.py test_visit_colour.py \
	test_reconstruct_burst.py test_updates.py test_openapi.py test_cli_server.py test_core_installation.py \
	test_frontier.py) \
	$(addprefix tests/unit/,test_calibration_measurements.py test_head_check.py test_trial_lenses.py \
	test_damaged_rows.py test_backup.py test_effects.py test_scene_files.py \
	test_paper_report.py)
# Minutes each: 1,250 damages, of which `make test` has a sample; pictures, layouts and a calibration of lenslets; the maker's chart; hard frames
# of several eyes, of which `make test-faults` has the grid; montages; guided calibrations, updates, hasty fingers and every
# alert in every language on the page, whose server side `make test-faults` tries; what moves on the page in every size.
LONG := $(addprefix tests/,hard/test_store_damage.py hard/test_edits.py hard/test_anonymous_client.py journey/test_roles.py hard/test_full_field.py hard/test_quality.py hard/test_background.py hard/test_flicker.py \
	hard/test_far_eyes.py hard/test_ghost.py hard/test_cut_pupils.py hard/test_spots.py hard/test_dark_border.py hard/test_uneven_light.py hard/test_sensor_lines.py \
	hard/test_given_field.py physics/test_lenslets.py physics/test_lens_design.py physics/test_lens_pictures.py \
	physics/test_independent_lens_frames.py \
	unit/test_calibration_lenslets.py journey/test_lens_heads.py unit/test_model_eye.py unit/test_calibration_sequence.py unit/test_montage.py \
	journey/test_visit_montage.py browser/test_calibration_wizard.py browser/test_software_update.py \
	browser/test_capture_edge_cases.py browser/test_alerts.py browser/test_instrument_faults.py browser/test_layout_shift.py \
	golden/test_golden_all_scenes.py)
NOT_HERE := not bench and not rig and not systemd and not paper and not site and not archive and not boot
# Workers take file after file in the order given: what takes long comes first, so that no worker begins it when the
# others end. pytest drops a file that is named beside its folder, so that each is named once.
IN_ORDER := --dist loadfile --no-loadscope-reorder
# Many tests wait for a clock, a process or a browser: three workers keep two cores busy.
WORKERS := -n 3 $(IN_ORDER)
# A test of the page waits for the page's debounce, for fades and for the browser's start.
PAGE_WORKERS := -n 4 $(IN_ORDER)
LONG_FAULTS := $(addprefix tests/,hard/test_press_and_command.py property/test_simulated_mark.py) $(INSTRUMENT_FAULTS)
LONG_PAGES := $(addprefix tests/browser/,test_visit.py test_viewer.py test_page_states.py)
LONG_GOLDEN := $(addprefix tests/golden/,test_golden_http.py test_golden_files.py test_golden_cli.py test_golden_exam.py)
tests_of = $(wildcard $(addsuffix /test_*.py,$(1)))

test: .venv/kernels browser ## Run the tests that a change needs first: units, instrument, server, a press on the page.
	@$(BIN)/python -m pytest $(WORKERS) -rR -m "$(NOT_HERE)" $(JOURNEYS) $(filter-out $(INSTRUMENT_FAULTS) $(LONG),$(call tests_of,tests/journey tests tests/unit))

test-ports: .venv/kernels buses ## Run the contract suites of drivers and simulated parts on emulated buses.
	@umockdev-wrapper $(BIN)/python -m pytest -n 2 --dist loadfile -m "not rig" tests/ports

test-faults: .venv/kernels strace ## Try kills, power cuts, flipped bits, bad frames, faults of every part, optics and invariants.
	@$(BIN)/python -m pytest $(WORKERS) -m "$(NOT_HERE)" $(LONG_FAULTS) $(filter-out $(LONG_FAULTS) $(LONG),$(call tests_of,$(FAULTS)))

test-browser: .venv/ready browser ## Try the page in every state, size and language, its viewer, speech and the technician's sections.
	@$(BIN)/python -m pytest $(PAGE_WORKERS) -rR $(LONG_PAGES) $(filter-out $(LONG_PAGES) $(LONG) $(JOURNEYS),$(call tests_of,tests/browser))

test-long: .venv/kernels browser strace ## Try 1,250 damages of a store, a client of the network without a login (as root), lenslets, hard frames of several eyes, montages, every alert, guided calibrations on the page.
	@$(BIN)/python -m pytest $(WORKERS) -rR -m "$(NOT_HERE)" $(LONG)

page-pictures: .venv/ready browser ## Take README's two pictures of the page again, on the real server with the simulated head.
	@$(BIN)/python -m tests.browser.readme_pictures

test-paper: .venv/ready ## Run the paper's experiments again, and show of every scene that nothing seen is left out.
	@$(BIN)/python -m pytest -n auto -m paper --timeout 900 tests/physics

test-hard: .venv/ready ## Run the whole grid of hard cases and write it to out/hard; it fails on a violation.
	@$(BIN)/diffuscope hard -o out/hard --check

test-systemd: .venv/ready ## Boot a real systemd in a container and try the units in it; needs root.
	@tests/systemd/install
	@$(BIN)/python -m pytest tests/systemd -rP
	@$(BIN)/python -m pytest tests/test_project_files.py -k "systemd_analyze_accepts or low_exposure_score"

# verity needs device-mapper where it is installed; FORMAT=plain is for trying out, on devices that were built with it.
FORMAT ?= verity
KEYS ?= out/keys

test-golden: .venv/ready buses ## Compare HTTP, command line, exam, buses, files and scenes with their golden records.
	@umockdev-wrapper $(BIN)/python -m pytest -n auto $(IN_ORDER) $(LONG_GOLDEN) $(filter-out $(LONG_GOLDEN) $(LONG),$(call tests_of,tests/golden))

test-exam: .venv/ready ## Run ten thousand random sequences of presses, faults and signals on the exam; N=count.
	@$(BIN)/python -m tests.property.exam_sequences $(N)

test-light: .venv/ready ## Run a thousand random sequences of presses, aiming and kills against the limits of dose; N=count.
	@$(BIN)/python -m tests.property.light_sequences $(N)

# An environment of its own: pyfftw imports dask.array wherever Dask is installed, 0.3 s in every process.
ARCHIVE_LOCK := services/archive/requirements.lock

.archive-venv/ready: $(ARCHIVE_LOCK) pyproject.toml | $(UV)
	@echo "Setting up .archive-venv (a minute, once)"
	@$(PYTHON) -m venv --without-pip .archive-venv
	@$(INSTALL) .archive-venv/bin/python -r $(ARCHIVE_LOCK)
	@$(INSTALL_THIS) .archive-venv/bin/python -e .
	@touch $@

test-archive: .archive-venv/ready ## Reprocess small archives on Dask: results, table, kills of workers, runs and schedulers.
	@.archive-venv/bin/python -m pytest -n 2 -m archive tests/archive

test-mutants: .venv/ready ## Run the tests of guard, dose ledger, store, exam and marks against seeded mutants; a quarter of an hour, not in CI.
	@$(BIN)/python -m tests.golden mutants

bundle: .venv/ready ## Build a signed update in out/, as root; KEYS=folder, FORMAT=plain, ARCH=arm64.
	@systemd/image/install $(ARCH)
	@[ -e "$(KEYS)/signer.key" ] || { echo "No keys in $(KEYS): making test keys there"; systemd/image/keys "$(KEYS)"; }
	@systemd/image/bundle --keys "$(KEYS)" --format $(FORMAT) $(if $(ARCH),--arch $(ARCH)) \
		-o out/diffuscope$(if $(ARCH),-$(ARCH)).raucb

test-appliance: .venv/ready ## Update a device from version to version, with real RAUC and a real systemd; needs root.
	@systemd/image/install
	@$(BIN)/python -m pytest tests/appliance -rP

# The card's processor is arm64; ARCH=amd64 shows the same root without the buses of the device tree.
test-boot: .venv/ready ## Boot the card in QEMU: page, device nodes, power cuts, update, rollback; as root, half an hour, not in CI.
	@tests/boot/install $(or $(ARCH),arm64)
	@ARCH=$(or $(ARCH),arm64) $(BIN)/python -m pytest -x -rP tests/boot

test-arm64: .venv/ready ## Run the solver's tests on an emulated 64-bit ARM, as root; half an hour, not in CI.
	@tests/arm64/run

browser: ## Install headless Chromium (Debian package) where it is missing.
	@tests/browser/install

# The contract suites once more, in an environment of another Python: what a Raspberry Pi's next system will bring.
OTHER_PYTHON ?= python3.13

.other-venv/ready: requirements.lock $(PI_LOCK) | $(UV)
	@$(OTHER_PYTHON) -m venv --without-pip .other-venv
	@$(INSTALL) .other-venv/bin/python -r requirements.lock
	@$(INSTALL) .other-venv/bin/python --no-deps -r $(PI_LOCK)
	@$(INSTALL_THIS) .other-venv/bin/python -e .
	@touch $@

test-other: .other-venv/ready buses ## Run the contract suites on another Python: OTHER_PYTHON=python3.13.
	@umockdev-wrapper .other-venv/bin/python -m pytest -n 2 --dist loadfile -m "not rig" tests/ports

strace: ## Install strace (Debian package) where it is missing.
	@tests/hard/install

stress-ng: ## Install stress-ng (Debian package) where it is missing.
	@tests/bench/install

buses: ## Install umockdev (Debian packages) where it is missing.
	@tests/ports/emulators/install

# The page has no build step; its JSDoc types are checked by a compiler that nothing else needs.
PAGE_TYPES := tests/browser/types

.venv/typescript/ready: $(PAGE_TYPES)/package-lock.json $(PAGE_TYPES)/install | .venv/ready
	@$(PAGE_TYPES)/install
	@touch $@

lint: .venv/ready .venv/typescript/ready ## Check style, types (Python and the page's JavaScript), and who imports whom.
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --diff --quiet .
	@$(BIN)/mypy --no-error-summary
	@.venv/typescript/node_modules/.bin/tsc --project $(PAGE_TYPES)
	@said=$$($(BIN)/lint-imports --no-logo) || { echo "$$said"; exit 1; }

VERSION = $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)

# The version is written, not computed from tags (services/decisions/0004-version-in-pyproject.md); the tag must equal it.
# --strict: a package that the database of PyPI does not answer for is a failure. Not part of CI, which needs no network for
# its result: an advisory of today would fail the commit of yesterday.
AUDIT := pip-audit==2.10.1 --strict --require-hashes --disable-pip

release: lint ## Check version, changelog, citation and known vulnerabilities of what the locks name, build wheel and source archive into dist, tag this commit.
	@[ -z "$$(git status --porcelain)" ] || { echo "Commit the changes first: a release is one commit"; exit 1; }
	@! sed -n '/^## Unreleased/,/^## [0-9]/p' CHANGELOG.md | grep -q '^\*' || \
		{ echo "Move the lines under Unreleased in CHANGELOG.md to a section with version and date"; exit 1; }
	@$(BIN)/python -m pytest -q tests/test_publication.py
	@$(UV) tool run --quiet $(AUDIT) -r requirements.lock -r systemd/image/requirements.lock
	@git rev-parse -q --verify "refs/tags/v$(VERSION)" >/dev/null || git tag -a "v$(VERSION)" -m "Diffuscope $(VERSION)"
	@[ "$$(git rev-parse "v$(VERSION)^{commit}")" = "$$(git rev-parse HEAD)" ] || \
		{ echo "v$(VERSION) is another commit: raise the version in pyproject.toml, CITATION.cff and CHANGELOG.md"; exit 1; }
	@rm -rf dist && $(BIN)/python -m hatchling build -d dist
	@echo "dist/ holds $(VERSION); to publish: git push origin v$(VERSION)"

bench: .venv/ready browser stress-ng ## Print figures of speed and truth, measured on this machine.
	@$(BIN)/python -m tests.bench

COUNT ?= 2000

bench-archive: .archive-venv/ready ## Print captures a minute on Dask and in bare processes, memory, and results after kills; COUNT=200, DATA=folder has recordings.
	@.archive-venv/bin/python -m tests.bench.archive $(COUNT) $(DATA)

bench-attacks: .venv/ready ## Measure status and press while clients hold connections that they do not use.
	@$(BIN)/python -m tests.bench.attacks

bench-budget: .venv/ready ## Press 60 times for each choice of the time budget: times from read-out and tap, rounds, colour.
	@$(BIN)/python -m tests.bench.budgets

bench-deadline: .venv/ready stress-ng ## Make 200 pictures within each of four time budgets beside stress-ng --cpu 4: late ones, rounds, PCC.
	@$(BIN)/python -m tests.bench.deadline

bench-pi: .venv/ready ## Print the factor of this board over the reference: one planned FFT pair and one reconstruction.
	@$(BIN)/python -m tests.bench.pi

bench-kills: .venv/ready buses ## Kill a process that holds the lamp, 200 times, and print when it was dark.
	@umockdev-wrapper $(BIN)/python -m tests.bench.kills

EYES ?= 20
bench-lesions: .venv/ready ## Print how many drawn lesions of each kind and size are found at one false grain a picture, for each head and 1, 4 and 8 frames; EYES=20.
	@$(BIN)/python -m tests.bench.lesions --eyes $(EYES)

bench-elements: .venv/ready ## Print picture, refraction and time behind diffuser, lenslets and one lens; PHOTOS="files" VESSELS="their masks", FLAGS="--curved --m-dpt 6".
	@$(BIN)/python -m tests.bench.elements --photo $(PHOTOS) --vessels $(VESSELS) $(FLAGS)

bench-element-refraction: .venv/ready ## Print error and coverage of the refraction of drawn eyes behind each element; EYES=200 behind lenslets (90 minutes), FLAGS="--other-eyes 60".
	@$(BIN)/python -m tests.bench.element_refraction --eyes $(if $(filter-out file,$(origin EYES)),$(EYES),200) $(FLAGS)

bench-store: .venv/ready ## End the instrument 200 times and damage its store: what is lost; time from start to a press.
	@$(BIN)/python -m tests.bench.store

FRAMES ?= 60
bench-refraction: .venv/ready ## Print error and coverage of the refraction on textbook frames; DATA=folder has photographs, FRAMES=60 of each sensor and field.
	@$(BIN)/python -m tests.bench.refraction --data "$(DATA)" --frames $(FRAMES)

bench-montage: .venv/ready ## Print the acceptance figures of the montage on photographs; DATA=folder has them, FIELD_DEG=33.4 turns an eye.
	@$(BIN)/python -m tests.bench.montage --data "$(DATA)" $(if $(FIELD_DEG),--field-deg $(FIELD_DEG))

bench-sides: .venv/ready ## Print how often left and right eyes are told apart, and how often wrongly; DATA=folder has photographs.
	@$(BIN)/python -m tests.bench.sides "$(DATA)"

bench-psf: .venv/ready ## Print what the PSF consistency check finds in recordings and simulated frames; DATA=folder has recordings.
	@$(BIN)/python -m tests.bench.psf_consistency "$(DATA)"

bench-frames: .venv/ready ## Print what bursts and colours of moving photographs give; DATA=folder has the photographs.
	@$(BIN)/python -m tests.bench.frames "$(DATA)"

bench-data: .venv/ready ## Compare all methods and LenslessPiCam on the pairs of a data set; DATA=folder has it.
	@mkdir -p out
	@$(BIN)/diffuscope bench "$(DATA)" --json out/bench-data.json

bench-retinas: .venv/ready ## Print the acceptance figures on real photographs and recordings; DATA=folder says where.
	@$(BIN)/python -m tests.bench.retinas --data "$(DATA)"

bench-wifi: .venv/ready browser ## Print how the page fares at the end of a bad link (network namespace; needs root).
	@$(BIN)/python -m tests.bench.wifi

readme: .venv/ready ## Run every command of README's table in a fresh folder: exit codes, seconds, promised words.
	@$(BIN)/python -m tests.bench.readme $(ONLY)

channel: .venv/ready ## Serve an update channel with a signed test bundle, and the page that finds it; slots are emulated.
	@$(BIN)/python -m tests.bench.channel $(PORT)

effects: .venv/ready ## Simulate two scenes with the effects that each calls for and with all: time, difference, picture.
	@$(BIN)/python -m tests.bench.effects out/effects.png

frontier: .venv/ready ## Measure what accuracy costs in time on this idle computer: README's plot, and the page's before its own.
	@$(BIN)/python -m tests.bench.frontier

results: .venv/ready ## Run the paper's experiments and write tests/paper/results.md with its pictures; ten minutes.
	@$(BIN)/diffuscope paper -o out/paper --page tests/paper/results.md

MINUTES ?= 10

bench-page: .venv/ready browser ## Print the time from tap to quick look, how alive the page stays, its memory; MINUTES=60.
	@$(BIN)/python -m tests.bench.page $(MINUTES)

# Without its declared dependencies (hydra, rawpy, paramiko, an old numpy): its ADMM needs only these.
bench-peers: .venv/ready ## Install LenslessPiCam and ducc0 beside, in .bench-venv, for the benches to compare with.
	@$(BIN)/python -m venv .bench-venv
	@.bench-venv/bin/pip install -qq --disable-pip-version-check --no-deps lensless==1.0.8 && \
		.bench-venv/bin/pip install -qq --disable-pip-version-check ducc0 pyfftw numpy scipy matplotlib opencv-python-headless pillow \
		|| { rm -rf .bench-venv; echo "LenslessPiCam could not be installed (is there a network?): make bench leaves it out"; }

# A CAD kernel is heavy, and no instrument needs one: an environment of its own.
PARTS_LOCK := hardware/parts/requirements.lock

.parts-venv/ready: $(PARTS_LOCK) hardware/parts/install | $(UV)
	@hardware/parts/install
	@echo "Setting up .parts-venv (a minute, once)"
	@$(PYTHON) -m venv --without-pip .parts-venv
	@$(INSTALL) .parts-venv/bin/python -r $(PARTS_LOCK)
	@touch $@

parts: .parts-venv/ready ## Write the printed parts as STEP and STL into out/parts.
	@.parts-venv/bin/python -m hardware.parts export out/parts

part-pictures: .parts-venv/ready ## Draw the pictures of the assembly guide anew, from the same models.
	@.parts-venv/bin/python -m hardware.parts pictures hardware/pictures

test-parts: .parts-venv/ready ## Measure the printed parts: closed, thick enough, clear of one another and of the light.
	@.parts-venv/bin/python -m pytest tests/parts

# Sphinx and matplotlib are needed by the documentation only: an environment of its own.
SITE_LOCK := services/research/site/requirements.lock

.site-venv/ready: $(SITE_LOCK) pyproject.toml | $(UV)
	@echo "Setting up .site-venv (a minute, once)"
	@$(PYTHON) -m venv --without-pip .site-venv
	@$(INSTALL) .site-venv/bin/python -r $(SITE_LOCK)
	@$(INSTALL_THIS) .site-venv/bin/python -e .
	@touch $@

site: .site-venv/ready ## Build the documentation with its gallery into out/site; GALLERY=0 leaves the scripts unrun.
	@services/research/site/build

test-site: .venv/ready browser site ## Build the documentation, then test its links, its search and the snippets of its pages.
	@$(BIN)/python -m pytest -n 2 --dist loadfile -m site tests/documentation

# Hashes for every platform in one file (x86-64 and aarch64), newest versions that pyproject.toml allows.
lock: | $(UV) ## Write requirements.lock anew, the part of it that a release needs, those of the printed parts and the documentation.
	@$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header \
		--extra instrument --extra test --group lock pyproject.toml -o requirements.lock
	@$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header \
		--constraints requirements.lock --constraints $(PI_LOCK) --extra instrument --extra board pyproject.toml -o systemd/image/requirements.lock
	@$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header \
		--constraints requirements.lock --extra instrument --extra archive --extra test --group lock \
		--group archive-test pyproject.toml -o $(ARCHIVE_LOCK)
	@$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header \
		hardware/parts/requirements.in -o $(PARTS_LOCK)
	@$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header \
		--constraints requirements.lock --extra instrument --extra docs --group lock pyproject.toml -o $(SITE_LOCK)

clean: ## Remove all that was made here; captures live elsewhere and stay.
	@rm -rf .venv .archive-venv .bench-venv .other-venv .parts-venv .site-venv .uv-venv .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .coverage build dist out *.egg-info
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
