# Two commands are all that is needed: `make run` and `make test`. Both install what is missing first.
.PHONY: run serve test captures foreign-plane exports python page page-test closed-loop faults soak kills service-figures fuzz accuracy bench api-fuzz systemd v4l2 rerun-test book documents deb setup install ci

run: ## build, serve the simulated rig, scan it over REST, say where the results are
	@scripts/install build
	@scripts/run

serve: ## build and serve until Ctrl-C; CONFIG names another configuration than the simulated rig's
	@scripts/install build
	@scripts/serve $(CONFIG)

test: ## every test that needs no device
	@scripts/install test
	@scripts/test

page: ## build the operator's page into web/dist
	@scripts/install build

page-test: ## the operator's page in Chromium against the service, about 3 minutes; pictures in target/page/screenshots
	@scripts/install test
	@scripts/page-test

captures: ## decode real captures made by others (POLSCAN_CAPTURES names their folder)
	@scripts/install build
	@scripts/captures

faults: ## let everything go wrong on the simulated rig, and see what it is called
	@scripts/install build
	@scripts/faults

soak: ## 500 scans in a row with clients, lists of 10 000 scans, and a camera torn away every 10 s for 10 minutes
	@scripts/install test
	@scripts/soak five_hundred_scans ten_thousand_scans
	@scripts/closed-loop torn_away_for_ten_minutes

kills: ## 50 deaths of the service at random moments under load
	@scripts/install build
	@scripts/soak fifty_deaths

service-figures: ## what the service costs: time to the first pattern, overhead, answers while it decodes
	@scripts/install build
	@scripts/soak figures

foreign-plane: ## check the decoder from outside, with an independent numpy model
	@scripts/install test
	@scripts/foreign-plane

exports: ## open the exported formats with readers of others and compare every value
	@scripts/install test
	@scripts/exports

python: ## check the Python package, its cookbook and its notebook against the service on the simulated rig
	@scripts/install test
	@scripts/python

closed-loop: ## scan at full size through the real window and a camera in software, about 2 minutes
	@scripts/install test
	@scripts/closed-loop size_of_the_papers_rig

fuzz: ## every parser with damaged input, 15 minutes each; scripts/fuzz SECONDS for less
	@scripts/install build
	@scripts/fuzz

accuracy: ## measure the scanner on the simulated rig, about 5 minutes; writes docs/accuracy.md and its plots
	@scripts/install build
	cargo run --locked --profile test --example accuracy

bench: ## measure how fast frames are decoded, against a plain read, OpenCV and numpy; writes docs/speed.md. STAGE measures one
	@scripts/install test
	@scripts/bench $(STAGE)

api-fuzz: ## ask a live service what its API document allows and what it does not, about 3 minutes
	@scripts/install test
	@scripts/api-fuzz

systemd: ## as root: the package, installed in a container with a systemd of its own; about 3 minutes
	@scripts/install systemd
	@scripts/systemd-test

v4l2: ## the driver of V4L2 cameras, on a kernel with a camera of its own in a virtual machine; about 2 minutes
	@scripts/install v4l2
	@scripts/v4l2-test

rerun-test: ## clouds in recordings and in a viewer of Rerun (220 MB the first time)
	@scripts/install rerun
	@scripts/rerun-test

book: ## docs/ as a book, in target/book
	@scripts/book

documents: ## check what the documents say: links, commands, configurations, keys of the report; run the cookbooks
	@scripts/install test
	@scripts/documents

deb: ## the Debian package, in target/debian
	@scripts/install build
	@scripts/deb

setup: ## system packages and the Python environment of the checks
	@scripts/install test

install: ## install program and systemd service; PREFIX and DESTDIR as usual
	@scripts/install-service

ci: ## what continuous integration runs
	@.ci/run
