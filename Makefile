# Two commands are all that is needed: `make run` and `make test`. Both install what is missing first.
.PHONY: run test captures foreign-plane install ci

run: ## build, scan the simulated rig, say where the results are
	@scripts/install build
	@scripts/run

test: ## every test that needs no device
	@scripts/install test
	@scripts/test

captures: ## decode real captures made by others (POLSCAN_CAPTURES names their folder)
	@scripts/install build
	@scripts/captures

foreign-plane: ## check the decoder from outside, with an independent numpy model
	@scripts/install test
	@scripts/foreign-plane

install: ## system packages and the Python environment of the checks
	@scripts/install test

ci: ## what continuous integration runs
	@.ci/run
