//! What happens on the window's thread: one client at a time opens the window and shows pictures.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use winit::{
    application::ApplicationHandler,
    dpi::{PhysicalPosition, PhysicalSize},
    event::WindowEvent,
    event_loop::{ActiveEventLoop, ControlFlow},
    platform::x11::WindowAttributesExtX11,
    raw_window_handle::{HasWindowHandle, RawWindowHandle},
    window::{Fullscreen, Window, WindowId},
};

use super::{
    link::{Client, Demand, News},
    open::Open,
    watch::Watch,
};
use crate::window::{
    displays::{Display, Place},
    protocol::{Asked, Fault, Reply, Want},
};

/// How long a window may take to come to its place.
const PLACING: Duration = Duration::from_secs(5);

/// Pause between two looks whether it has.
const LOOK: Duration = Duration::from_millis(5);

/// A window that is on its way to its place.
pub(super) struct Opening {
    client: Client,
    pub(super) want: Want,
    pub(super) display: Display,
    pub(super) place: Place,
    pub(super) window: Arc<Window>,
    pub(super) id: u32,
    pub(super) watch: Watch,
    since: Instant,
}

enum State {
    Closed,
    Opening(Box<Opening>),
    Open(Box<Open>),
}

/// The window's thread.
pub(super) struct App {
    /// Whether the process ends with its client.
    alone: bool,
    owner: Option<u64>,
    state: State,
}

impl App {
    pub(super) fn new(alone: bool) -> Self {
        Self { alone, owner: None, state: State::Closed }
    }

    fn demand(&mut self, event_loop: &ActiveEventLoop, client: &Client, demand: Demand) {
        if let Demand::Open(want) = demand {
            if self.owner.is_some_and(|owner| owner != client.id) {
                let detail = "another program has the projector's window; end it first";
                return client.fail(Fault::Unavailable(detail.into()));
            }
            self.owner = Some(client.id);
            return self.open(event_loop, client, want);
        }
        let State::Open(open) = &mut self.state else {
            return client.fail(Fault::Broken("the window is not open".into()));
        };
        if self.owner != Some(client.id) {
            return client.fail(Fault::Unavailable("another program has the projector's window".into()));
        }
        let answer = match demand {
            Demand::Load(slides) => {
                let count = slides.len() as u32;
                open.load(slides).map(|()| Reply::Loaded { count })
            }
            Demand::Show(slide) => open.show(slide).map(Reply::Shown),
            Demand::Open(_) => return,
        };
        client.answer(&answer.unwrap_or_else(Reply::Failed));
    }

    fn open(&mut self, event_loop: &ActiveEventLoop, client: &Client, want: Want) {
        if let State::Open(open) = &mut self.state
            && open.is_as(&want)
        {
            return client.answer(&Reply::Hello(open.hello().clone()));
        }
        // Of the old window nothing may be left when the new one comes.
        self.state = State::Closed;
        match start(event_loop, client, want) {
            Ok(opening) => self.state = State::Opening(Box::new(opening)),
            Err(fault) => client.fail(fault),
        }
    }

    /// Looks whether an opening window is in its place.
    fn settle(&mut self) {
        if !matches!(self.state, State::Opening(_)) {
            return;
        }
        let State::Opening(opening) = std::mem::replace(&mut self.state, State::Closed) else { return };
        let found = opening.watch.place(opening.id);
        let placed = matches!(&found, Ok(Some(place)) if *place == opening.place);
        if found.is_ok() && !placed && opening.since.elapsed() < PLACING {
            self.state = State::Opening(opening);
            return;
        }
        let client = opening.client.clone();
        let opened = match found {
            Err(fault) => Err(fault),
            Ok(place) if !placed => Err(Fault::Refused {
                what: Asked::Scale,
                requested: format!("a window at {}", written(opening.place)),
                offered: place
                    .map_or("none on the screen".into(), |place| format!("one at {}", written(place))),
            }),
            Ok(_) => Open::new(*opening),
        };
        match opened {
            Ok(open) => {
                client.answer(&Reply::Hello(open.hello().clone()));
                self.state = State::Open(Box::new(open));
            }
            Err(fault) => client.fail(fault),
        }
    }

    fn gone(&mut self, event_loop: &ActiveEventLoop, id: u64) {
        if self.alone {
            event_loop.exit();
        } else if self.owner == Some(id) {
            self.owner = None;
            if let State::Open(open) = &mut self.state {
                // Whoever was watching is gone; the next client hears what is wrong.
                let _ = open.show(None);
            }
        }
    }
}

impl ApplicationHandler<News> for App {
    fn resumed(&mut self, _: &ActiveEventLoop) {}

    fn user_event(&mut self, event_loop: &ActiveEventLoop, news: News) {
        match news {
            News::Demand(client, demand) => self.demand(event_loop, &client, demand),
            News::Gone(id) => self.gone(event_loop, id),
        }
    }

    fn window_event(&mut self, _: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        if let (State::Open(open), WindowEvent::Resized(_) | WindowEvent::Moved(_)) = (&mut self.state, event)
        {
            open.doubt();
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        self.settle();
        event_loop.set_control_flow(match self.state {
            State::Opening(_) => ControlFlow::WaitUntil(Instant::now() + LOOK),
            _ => ControlFlow::Wait,
        });
    }
}

/// A place as X writes it.
pub(super) fn written(place: Place) -> String {
    format!("{}x{}+{}+{}", place.width, place.height, place.x, place.y)
}

/// Finds the display and makes a window that covers it.
fn start(event_loop: &ActiveEventLoop, client: &Client, want: Want) -> Result<Opening, Fault> {
    let mut watch = Watch::new(None)?;
    let (display, place) = watch.choose(&want)?;
    let managed = watch.has_manager()?;
    let mut attributes = Window::default_attributes()
        .with_title("polscan projector")
        .with_decorations(false)
        .with_position(PhysicalPosition::new(place.x, place.y))
        .with_inner_size(PhysicalSize::new(place.width, place.height));
    if managed {
        let corner = PhysicalPosition::new(place.x, place.y);
        let monitor = event_loop.available_monitors().find(|monitor| monitor.position() == corner);
        attributes = attributes.with_fullscreen(Some(Fullscreen::Borderless(monitor)));
    } else {
        // Nobody would make it full-screen: it keeps the size that it is given, and nobody else's hands off it.
        attributes = attributes.with_override_redirect(true).with_resizable(false);
    }
    let window = event_loop
        .create_window(attributes)
        .map_err(|error| Fault::Unavailable(format!("the X server gives no window: {error}")))?;
    window.set_cursor_visible(false);
    let scale = window.scale_factor();
    if scale != 1.0 {
        return Err(Fault::Refused {
            what: Asked::Scale,
            requested: "scale 1".into(),
            offered: format!("scale {scale} on {}", display.connector),
        });
    }
    let id = match window.window_handle().map(|handle| handle.as_raw()) {
        Ok(RawWindowHandle::Xlib(handle)) => handle.window as u32,
        Ok(RawWindowHandle::Xcb(handle)) => handle.window.get(),
        other => return Err(Fault::Broken(format!("the window is none of an X server: {other:?}"))),
    };
    watch.follow(id)?;
    watch.stay_awake()?;
    let (client, since) = (client.clone(), Instant::now());
    Ok(Opening { client, want, display, place, window: Arc::new(window), id, watch, since })
}
