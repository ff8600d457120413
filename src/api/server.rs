//! From sockets to requests: accepts connections, bounds them, and ends them in good order.

use std::{
    net::{IpAddr, SocketAddr},
    sync::Arc,
    time::Duration,
};

use axum::Router;
use hyper_util::{
    rt::{TokioIo, TokioTimer},
    server::graceful::{GracefulShutdown, Watcher},
    service::TowerToHyperService,
};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::TcpListener,
    sync::{Semaphore, watch},
};

use super::tls::Tls;

/// Connections at once.
const CONNECTIONS: usize = 512;

/// How long a client may take over the head of a request, and before that over the greeting of TLS.
const PATIENCE: Duration = Duration::from_secs(10);

/// How long requests may go on after the end has been asked for.
const FAREWELL: Duration = Duration::from_secs(3);

/// A bound socket.
#[derive(Debug)]
pub struct Listening {
    listener: TcpListener,
    address: SocketAddr,
}

impl Listening {
    /// Binds `address`; port 0 takes a free one.
    pub async fn bind(address: SocketAddr) -> std::io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        Ok(Self { address: listener.local_addr()?, listener })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The address that clients on this machine reach it by.
    pub fn ip(&self) -> IpAddr {
        self.address.ip()
    }
}

/// Serves until `stopping` says so, then lets requests end. With `tls` nothing is understood that is not encrypted.
pub async fn serve(
    listening: Listening,
    routes: Router,
    tls: Option<Tls>,
    mut stopping: watch::Receiver<bool>,
) {
    let graceful = GracefulShutdown::new();
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        let accepted = tokio::select! {
            accepted = listening.listener.accept() => accepted,
            _ = stopping.wait_for(|stopping| *stopping) => break,
        };
        let stream = match accepted {
            Ok((stream, _)) => stream,
            Err(error) => {
                // Out of file descriptors, most likely: others must end first.
                tracing::warn!(%error, "a connection was not accepted");
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        let Ok(place) = places.clone().try_acquire_owned() else { continue };
        let _ = stream.set_nodelay(true);
        let (routes, acceptor, watcher) =
            (routes.clone(), tls.as_ref().map(Tls::acceptor), graceful.watcher());
        tokio::spawn(async move {
            match acceptor {
                None => converse(stream, routes, watcher).await,
                Some(acceptor) => match tokio::time::timeout(PATIENCE, acceptor.accept(stream)).await {
                    Ok(Ok(stream)) => converse(stream, routes, watcher).await,
                    Ok(Err(error)) => tracing::debug!(%error, "a client and TLS"),
                    Err(_) => {}
                },
            }
            drop(place);
        });
    }
    drop(listening);
    let _ = tokio::time::timeout(FAREWELL, graceful.shutdown()).await;
}

/// Answers the requests of one connection.
async fn converse<S>(stream: S, routes: Router, watcher: Watcher)
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let connection = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(PATIENCE)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(routes));
    // A client that goes away in the middle is no news.
    let _ = watcher.watch(connection).await;
}
