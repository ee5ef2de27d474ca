//! `semidense-bridge view`: the live page, or a finished run.

use std::io::Write;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use semidense::service::child::follow_supervisor;
use semidense::service::shutdown::Shutdown;
use semidense::wire::port::{WaitError, wait};

use crate::command::{CommandResult, CommonArguments, note, number_within};
use crate::feed::{Feed, Listener, USUAL_DEPTH};
use crate::session::Wants;
use crate::web::finished::{read_run, read_summary};
use crate::web::guard::{Guard, new_token};
use crate::web::history::follow;
use crate::web::saving::Saver;
use crate::web::scene::{Scene, USUAL_POINTS};
use crate::web::server::{Server, Shown};
use crate::web::stream::StreamOptions;

/// Added to the niceness that it was started with: it runs when nobody else wants to.
const NICENESS: i32 = 10;
/// Time between two looks whether the topics can still be read.
const LOOK_PERIOD: Duration = Duration::from_millis(500);

/// Serve a web page: a running instance live, or a finished run with a time slider
///
/// Live: camera image with the keyframe's depth, the map as it grows, state and its reason, rates, latencies, a button that
/// saves the map; waits for an instance, and for the next one when it ends. On the same port: /metrics for Prometheus.
/// Nothing is loaded from elsewhere. It is one more reader: the pipeline does not notice it.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    semidense view                          then open http://127.0.0.1:8765\n  \
    semidense view output/latest            the newest finished run\n  \
    semidense view --listen 0.0.0.0:8765    for a phone: open the address with the token that is printed\n  \
    ssh -L 8765:127.0.0.1:8765 robot        from elsewhere, without opening a port")]
pub struct ViewArguments {
    /// Folder of a finished run [default: what runs, live]
    #[arg(value_name = "FOLDER")]
    folder: Option<PathBuf>,
    /// Address and port to serve on; other machines reach it only with an address of this one, 0.0.0.0 for all
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8765")]
    listen: SocketAddr,
    /// Let everybody in who reaches the address: without this, addresses beyond this machine need a token
    #[arg(long)]
    no_token: bool,
    /// A name of this machine besides localhost and its IP addresses that pages are opened by; may be repeated
    #[arg(long, value_name = "NAME")]
    host: Vec<String>,
    /// Another site whose pages may connect.
    #[arg(
        long,
        value_name = "ORIGIN",
        help = "Another site whose pages may connect, e.g. https://app.foxglove.dev; may be repeated"
    )]
    allow_origin: Vec<String>,
    /// Most images a second for each page
    #[arg(long, value_name = "HZ", default_value_t = 10.0, value_parser = rate)]
    image_rate: f64,
    /// Most points that are kept of the map: 8 bytes each, here and in each page
    #[arg(long, value_name = "N", default_value_t = USUAL_POINTS, value_parser = points)]
    max_points: usize,
    /// Folder in which the button makes a new folder for the map
    #[arg(long, value_name = "DIR", default_value = "output")]
    maps: PathBuf,
}

fn rate(text: &str) -> Result<f64, String> {
    number_within(text, 0.1..=60.0, "needs a number from 0.1 to 60")
}

fn points(text: &str) -> Result<usize, String> {
    number_within(text, 10_000..=50_000_000, "needs a number from 10000 to 50000000")
}

/// Runs it until a signal comes.
pub fn run(common: &CommonArguments, arguments: &ViewArguments) -> CommandResult {
    let shutdown = Shutdown::install()?;
    // Beside a run: it ends with that, however that ends.
    follow_supervisor()?;
    // Whatever else the machine does comes first; a refusal changes nothing.
    let _ = rustix::process::nice(NICENESS);
    let is_local = arguments.listen.ip().is_loopback();
    let token = (!is_local && !arguments.no_token).then(new_token).transpose()?;
    let guard = Guard {
        hosts: arguments.host.iter().cloned().chain(own_names()).collect(),
        origins: arguments.allow_origin.clone(),
        token: token.clone(),
    };
    let shown = match &arguments.folder {
        Some(folder) => {
            let block = read_run(folder, arguments.max_points)?;
            Shown::Finished(block, folder.clone(), read_summary(folder))
        }
        None => live(common, arguments)?,
    };
    let server = Server::open(arguments.listen, guard, shown)?;
    say(&server, arguments, token.as_deref());
    server.start()?;
    if let Shown::Live { feed, scene, .. } = &server.shown {
        let (listener, shown) = (feed.listen(USUAL_DEPTH), Arc::clone(scene));
        start("scene", move || keep_up(&listener, &shown))?;
        let (server, scene, place) = (Arc::clone(&server), Arc::clone(scene), common.place()?);
        start("history", move || follow(&place, &scene, &server.is_over))?;
    }
    let failure = wait_for_end(&shutdown, &server.shown)?;
    server.is_over.store(true, std::sync::atomic::Ordering::Relaxed);
    match failure {
        Some(failure) => Err(failure.into()),
        None => Ok(ExitCode::SUCCESS),
    }
}

fn live(
    common: &CommonArguments,
    arguments: &ViewArguments,
) -> Result<Shown, Box<dyn std::error::Error>> {
    let place = common.place()?;
    let wants = Wants { frames: true, keyframes: true, graph: true, adjustments: false };
    Ok(Shown::Live {
        feed: Feed::start(place.clone(), "view", wants)?,
        scene: Arc::new(Scene::new(arguments.max_points)),
        stream: StreamOptions {
            instance: place.instance.clone(),
            image_rate_hz: arguments.image_rate,
        },
        saver: Saver::new(place, &arguments.maps),
    })
}

/// Takes in what comes until nothing more will.
fn keep_up(listener: &Listener, scene: &Scene) {
    while let Ok(event) = listener.next(LOOK_PERIOD) {
        event.into_iter().for_each(|event| scene.take(event));
    }
}

fn start(name: &str, run: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
    std::thread::Builder::new().name(name.to_owned()).spawn(run).map(drop)
}

/// Until a signal comes, or the topics cannot be read any more.
fn wait_for_end(shutdown: &Shutdown, shown: &Shown) -> Result<Option<String>, WaitError> {
    while !shutdown.is_requested() {
        wait(&[], Some(shutdown.descriptor()), LOOK_PERIOD)?;
        if let Shown::Live { feed, .. } = shown
            && let Some(failure) = feed.failure()
        {
            return Ok(Some(failure));
        }
    }
    Ok(None)
}

/// The names that this machine has in its own network.
fn own_names() -> Vec<String> {
    let name = std::fs::read_to_string(Path::new("/proc/sys/kernel/hostname")).unwrap_or_default();
    let name = name.trim();
    if name.is_empty() { Vec::new() } else { vec![name.to_owned(), format!("{name}.local")] }
}

/// The address of this machine in the network that its default route leads to.
fn own_address() -> Option<IpAddr> {
    /// Of a network for documentation (RFC 5737): connecting a datagram socket chooses a route and sends nothing.
    const ELSEWHERE: (Ipv4Addr, u16) = (Ipv4Addr::new(192, 0, 2, 1), 9);
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
    socket.connect(ELSEWHERE).ok()?;
    Some(socket.local_addr().ok()?.ip())
}

/// Prints the addresses to open, on standard output: a script may read it.
fn say(server: &Server, arguments: &ViewArguments, token: Option<&str>) {
    let address = server.address;
    let shown: Vec<String> = match address.ip() {
        // It stands for all addresses: the name is one that others can open, the number where names are not looked up.
        ip if ip.is_unspecified() => {
            let number = own_address().map(|ip| SocketAddr::new(ip, address.port()).to_string());
            let name = own_names().pop().map(|name| format!("{name}:{}", address.port()));
            let known: Vec<String> = name.into_iter().chain(number).collect();
            match known.is_empty() {
                true => vec![format!("ADDRESS-OF-THIS-MACHINE:{}", address.port())],
                false => known,
            }
        }
        _ => vec![address.to_string()],
    };
    let token = token.map(|token| format!("?token={token}")).unwrap_or_default();
    for shown in &shown {
        let _ = writeln!(std::io::stdout(), "http://{shown}/{token}");
    }
    let _ = std::io::stdout().flush();
    if arguments.no_token && !address.ip().is_loopback() {
        note(&format!(
            "warning: everybody who reaches {address} sees the camera and can save the map: there is no token"
        ));
    }
}
