//! Threads that compute while others must be on time.

/// How much they stand back behind all others.
const NICE: i32 = 5;

/// A pool of threads that stand back behind all others of the machine; `threads`: how many, as many as there are cores
/// where it is `None`.
///
/// # Errors
/// The system has no more threads.
pub fn background_pool(threads: Option<usize>) -> Result<rayon::ThreadPool, rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads.unwrap_or(0))
        .thread_name(|number| format!("compute-{number}"))
        .start_handler(|_| {
            // On Linux this is about the calling thread alone.
            if let Err(error) = rustix::process::nice(NICE) {
                tracing::debug!(%error, "computing threads run at the priority of all others");
            }
        })
        .build()
}
