# Two commands are all that is needed: `make run` and `make test`. Both install what is missing first.
.PHONY: run test captures foreign-plane fuzz accuracy faults install ci

run: ## build, scan the simulated rig, say where the results are
	@scripts/install build
	@scripts/run

test: ## every test that needs no device
	@scripts/install test
	@scripts/test

captures: ## decode real captures made by others (POLSCAN_CAPTURES names their folder)
	@scripts/install build
	@scripts/captures

faults: ## let everything go wrong on the simulated rig, and see what it is called
	@scripts/install build
	@scripts/faults

foreign-plane: ## check the decoder from outside, with an independent numpy model
	@scripts/install test
	@scripts/foreign-plane

fuzz: ## every parser with damaged input, 15 minutes each; scripts/fuzz SECONDS for less
	@scripts/install build
	@scripts/fuzz

accuracy: ## measure the scanner on the simulated rig, about 5 minutes; writes docs/accuracy.md and its plots
	@scripts/install build
	cargo run --locked --profile test --example accuracy

install: ## system packages and the Python environment of the checks
	@scripts/install test

ci: ## what continuous integration runs
	@.ci/run
