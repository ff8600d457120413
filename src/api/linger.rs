//! Answers that reach a client which is still sending: a connection that is closed over unread bytes is reset, and the
//! client loses the answer that says why.

use std::{
    sync::{Arc, Mutex, PoisonError},
    task::{Context, Poll},
    time::Duration,
};

use axum::{
    body::{Body, BodyDataStream, Bytes, HttpBody},
    extract::Request,
    http::header,
};
use futures_util::{StreamExt, stream::poll_fn};

/// Most that is taken in of a body that nobody wanted.
const MOST_BYTES: usize = 1 << 20;

/// How long the rest of such a body is waited for.
const PATIENCE: Duration = Duration::from_secs(1);

/// The body of a request, of which a handler reads what it wants.
#[derive(Debug, Clone)]
pub struct Rest(Arc<Mutex<Option<BodyDataStream>>>);

impl Rest {
    /// The request, to be handled, and what will be left of its body; nothing where there is none, or where the client
    /// asks first whether it shall send one.
    pub fn of(request: Request) -> (Request, Option<Self>) {
        if request.body().is_end_stream() || request.headers().contains_key(header::EXPECT) {
            return (request, None);
        }
        let (head, body) = request.into_parts();
        let rest = Self(Arc::new(Mutex::new(Some(body.into_data_stream()))));
        let reader = rest.clone();
        let body = Body::from_stream(poll_fn(move |context| reader.poll(context)));
        (Request::from_parts(head, body), Some(rest))
    }

    /// Takes in what has not been read, within limits.
    pub async fn take_in(self) {
        let mut stream = poll_fn(|context| self.poll(context));
        let whole = async {
            let mut left = MOST_BYTES;
            while let Some(Ok(bytes)) = stream.next().await {
                let Some(less) = left.checked_sub(bytes.len()) else { break };
                left = less;
            }
        };
        let _ = tokio::time::timeout(PATIENCE, whole).await;
    }

    fn poll(&self, context: &mut Context<'_>) -> Poll<Option<Result<Bytes, axum::Error>>> {
        let mut stream = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(reading) = stream.as_mut() else { return Poll::Ready(None) };
        let read = reading.poll_next_unpin(context);
        if matches!(read, Poll::Ready(None | Some(Err(_)))) {
            *stream = None;
        }
        read
    }
}
