# Two commands are all that is needed: `make run` and `make test`. Both install what is missing first.
.PHONY: run serve test captures foreign-plane setup install ci

run: ## build, serve the simulated rig, scan it over REST, say where the results are
	@scripts/install build
	@scripts/run

serve: ## build and serve until Ctrl-C; CONFIG names another configuration than the simulated rig's
	@scripts/install build
	@scripts/serve $(CONFIG)

test: ## every test that needs no device
	@scripts/install test
	@scripts/test

captures: ## decode real captures made by others (POLSCAN_CAPTURES names their folder)
	@scripts/install build
	@scripts/captures

foreign-plane: ## check the decoder from outside, with an independent numpy model
	@scripts/install test
	@scripts/foreign-plane

setup: ## system packages and the Python environment of the checks
	@scripts/install test

install: ## install program and systemd service; PREFIX and DESTDIR as usual
	@scripts/install-service

ci: ## what continuous integration runs
	@.ci/run
