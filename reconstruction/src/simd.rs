//! The same code compiled for the vector units that a machine may have, chosen while the program runs.
//!
//! No kernel is written twice: a [`Work`] is inlined into a function that may use wider registers. Floating-point
//! operations and their order are those of the source in every copy (nothing is fused or reordered), so results are the
//! same to the bit.

/// A set of vector instructions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum InstructionSet {
    /// What the program was compiled for.
    Portable,
    /// 256-bit registers.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// 512-bit registers with operations on bytes and words.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

/// Something to do with the widest registers. `run` and all that it calls in its loops must be `#[inline(always)]`.
pub(crate) trait Work {
    /// What comes of it.
    type Output;
    /// Does it.
    fn run(self) -> Self::Output;
}

impl InstructionSet {
    /// Every set that this machine has, from the plainest to the widest.
    pub fn available() -> Vec<Self> {
        #[cfg(target_arch = "x86_64")]
        {
            let mut sets = vec![Self::Portable];
            if std::is_x86_feature_detected!("avx2") {
                sets.push(Self::Avx2);
            }
            if std::is_x86_feature_detected!("avx512f")
                && std::is_x86_feature_detected!("avx512bw")
                && std::is_x86_feature_detected!("avx512dq")
                && std::is_x86_feature_detected!("avx512vl")
            {
                sets.push(Self::Avx512);
            }
            sets
        }
        #[cfg(not(target_arch = "x86_64"))]
        vec![Self::Portable]
    }

    /// The widest set that this machine has.
    pub fn widest() -> Self {
        Self::available().last().copied().unwrap_or(Self::Portable)
    }

    /// Does the work with this set, which must be one of [`available`](Self::available).
    pub fn run<W: Work>(self, work: W) -> W::Output {
        match self {
            Self::Portable => work.run(),
            // SAFETY: sets come from `available` alone, which has asked the processor.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { with_avx2(work) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { with_avx512(work) },
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn with_avx2<W: Work>(work: W) -> W::Output {
    work.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512bw,avx512dq,avx512vl")]
fn with_avx512<W: Work>(work: W) -> W::Output {
    work.run()
}
