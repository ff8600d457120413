//! What becomes of groups that have been judged.

use polscan_drivers::clock::Timestamp;
use polscan_patterns::Role;

use super::{
    super::{
        judge::{PairVerdict, Suspicion},
        plan::Group,
        record::Finding,
    },
    Machine, Phase,
    types::{Action, Diagnosis, Outcome, Subject},
};

/// Refused pairs, with none accepted, that put the references they were judged against in doubt.
const DOUBTFUL_REFERENCES: u32 = 2;

impl Machine {
    pub(super) fn judged(
        &mut self,
        now: Timestamp,
        phase: Phase,
        subject: Subject,
        verdict: PairVerdict,
    ) -> Vec<Action> {
        self.judging = None;
        let group = subject.group();
        let role = self.roles[self.groups[group].steps().start];
        let finding = |suspicion: Suspicion| Finding {
            reason: suspicion.reason,
            role: Some(role),
            evidence: suspicion.evidence,
            sigma: Some(suspicion.sigma),
        };
        let refused = matches!(verdict, PairVerdict::Retake(_));
        self.references_hold |= matches!(subject, Subject::Pair { .. }) && !refused;
        let mut actions = match verdict {
            PairVerdict::Accept => vec![Action::Accept { group }],
            PairVerdict::Degraded(suspicion) => {
                self.findings.push(finding(suspicion));
                vec![Action::Accept { group }]
            }
            // Light that stays changed: another try would show the same, and the decode stands.
            PairVerdict::Retake(suspicion)
                if is_of_the_light(&suspicion.reason) && !self.may_help(group, &suspicion) =>
            {
                self.findings.push(finding(suspicion));
                vec![Action::Accept { group }]
            }
            PairVerdict::Retake(suspicion) if self.may_repeat(group) => {
                self.repeat_judged(subject, suspicion)
            }
            // What has changed since the first references stays changed: the scan says so and stands.
            PairVerdict::Retake(suspicion)
                if matches!(subject, Subject::Drift { .. }) && !shows_another_picture(&suspicion) =>
            {
                self.findings.push(finding(suspicion));
                vec![Action::Accept { group }]
            }
            PairVerdict::Retake(suspicion) => {
                let evidence = self.with_tries(group, suspicion.evidence);
                let Some(light) = self.changed_light(subject) else {
                    let reason = suspicion.reason;
                    let diagnosis = Diagnosis { reason, role: Some(role), evidence, source: None };
                    return self.finish(Outcome::Failed(diagnosis));
                };
                // In light that changes from take to take one pair cannot tell; all of them together can.
                let evidence = format!("{evidence}; the light changed between the takes");
                self.findings.push(finding(Suspicion { reason: light, evidence, ..suspicion }));
                vec![Action::Accept { group }]
            }
        };
        match phase {
            Phase::Shown { flip } => actions.push(self.expose(now, flip)),
            Phase::Judging => actions.extend(self.advance(now)),
            phase => self.phase = phase,
        }
        actions
    }

    /// Takes what was judged again, when the group under way is complete; the first references too where no pair
    /// so far agrees with them.
    fn repeat_judged(&mut self, subject: Subject, suspicion: Suspicion) -> Vec<Action> {
        let group = subject.group();
        let mut actions = vec![self.enter_retake(group, suspicion.reason.clone(), suspicion.evidence)];
        let is_reference = |machine: &Self, group: usize| {
            let role = machine.roles[machine.groups[group].steps().start];
            matches!(machine.groups[group], Group::Single { .. }) && !matches!(role, Role::Code { .. })
        };
        // Behind references that are to be repeated: it is judged against them.
        let place = self.queue.iter().take_while(|&&queued| is_reference(self, queued)).count();
        self.queue.insert(place, group);
        self.refused_pairs += u32::from(matches!(subject, Subject::Pair { .. }));
        if self.refused_pairs < DOUBTFUL_REFERENCES || self.references_hold || self.references_repeated {
            return actions;
        }
        self.references_repeated = true;
        for reference in (0..self.groups.len()).rev() {
            if is_reference(self, reference) && self.may_repeat(reference) {
                self.queue.push_front(reference);
                let evidence = format!("the first {} pairs do not agree with it", self.refused_pairs);
                actions.push(self.enter_retake(reference, suspicion.reason.clone(), evidence));
            }
        }
        actions
    }

    /// Whether another try may bring a picture in better light. Notes where one was in vain.
    fn may_help(&mut self, group: usize, suspicion: &Suspicion) -> bool {
        let in_vain = self.retaken.iter().any(|take| take.group == group && take.reason == suspicion.reason);
        if in_vain && !self.lasting.contains(&suspicion.reason) {
            self.lasting.push(suspicion.reason.clone());
        }
        self.may_repeat(group) && !self.lasting.contains(&suspicion.reason)
    }

    /// Slug of the change of the light that a pair was taken again for, or any other pair in vain.
    fn changed_light(&self, subject: Subject) -> Option<String> {
        let Subject::Pair { group } = subject else { return None };
        let own = self.retaken.iter().filter(|take| take.group == group).map(|take| &take.reason);
        own.chain(&self.lasting).find(|reason| is_of_the_light(reason)).cloned()
    }
}

/// Whether frames of this reason show what was asked for in another light.
fn is_of_the_light(reason: &str) -> bool {
    matches!(reason, "flicker" | "ambient-drift" | "exposure-drift")
}

/// Whether a frame is not the one that was asked for: as a reference it would spoil the mean of the good ones.
fn shows_another_picture(suspicion: &Suspicion) -> bool {
    matches!(suspicion.reason.as_str(), "stale-frame" | "torn-frame")
}
