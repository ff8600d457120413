//! The command line: arguments in, exit code out. What the commands do lives in `commands`.

use std::{
    io::IsTerminal,
    path::{Path, PathBuf},
};

use clap::{Args, Parser, Subcommand};
use polscan_patterns::Mode;

use crate::{
    api::Scope,
    commands,
    compare::Method,
    config::{Layers, Override},
    engine::{DecodeRequest, Failure},
    report::NamedRegion,
};

/// 3D scanner for objects too shiny and too black for ordinary structured light.
#[derive(Debug, Parser)]
#[command(name = "polscan", version, max_term_width = 100)]
struct Cli {
    /// Print one machine-readable object to stdout; progress and logs stay on stderr.
    #[arg(long, global = true)]
    json: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Scan once on the configured rig and write a bundle.
    Scan(Scan),
    /// Decode recorded frames, our own or foreign ones.
    Decode(Decode),
    /// Write a scan in the formats of other programs: E57, PCD, XYZ, OBJ; maps as TIFF and PNG.
    Export(commands::ExportArgs),
    /// Compare the paper's method, ordinary Gray code and pse on one scene, as one page and one file of figures.
    Compare(Compare),
    /// Measure what the rig is like, for scans to use.
    #[command(subcommand)]
    Calibrate(commands::Calibrate),
    /// Forecast what a rig will do from its data sheets.
    Plan(commands::PlanArgs),
    /// Measure a known artefact: whether the rig still measures as it should, with its history.
    Verify(commands::VerifyArgs),
    /// Write the pattern images as PNG, with the manifest that describes them.
    Patterns(Patterns),
    /// Run as a service with a REST interface.
    Serve(Serve),
    /// Access tokens of the service.
    #[command(subcommand)]
    Token(Token),
    /// The service's store of scans.
    #[command(subcommand)]
    Store(Store),
    /// Print the API document of the service.
    Openapi,
    /// List cameras and projectors, usable or not.
    Devices(ConfigArgs),
    /// Say what is wrong with this machine for the configured rig, and what to do about it.
    Doctor(ConfigArgs),
    /// Hold one picture on the projector for set-up, until an interrupt.
    Show(Show),
    /// Own the projector's full-screen window: for the service, which starts this by itself where it can.
    Projector {
        /// Socket to serve at, for a service that cannot reach the X server itself (its `projector.socket`).
        #[arg(long, value_name = "SOCKET")]
        listen: Option<PathBuf>,
    },
    /// Report every fault of a configuration.
    CheckConfig {
        /// Configuration file.
        file: PathBuf,
    },
}

#[derive(Debug, Args)]
struct ConfigArgs {
    /// Configuration file; what it leaves out is as in config/default.toml.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct Show {
    #[command(flatten)]
    config: ConfigArgs,
    /// white, h, v, black, focus, crosshair, checker, or a pattern such as column-0 or row-3-inverse.
    picture: String,
}

#[derive(Debug, Args)]
struct Serve {
    #[command(flatten)]
    config: ConfigArgs,
    /// Address and port to listen on; port 0 takes a free one.
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<String>,
    /// Folder of the scans.
    #[arg(long, value_name = "DIR")]
    store: Option<String>,
    /// File to write the address to, once it is listened on.
    #[arg(long, value_name = "FILE")]
    address_file: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
enum Token {
    /// Make a token and print it; the file keeps only its hash. A running service knows it within a second.
    Add {
        /// Name of the token, for the one who looks after the file.
        name: String,
        /// read, scan or admin; each includes those before it.
        #[arg(long)]
        scope: Scope,
        /// File of tokens, as in api.tokens; made with mode 0600 where it is missing.
        #[arg(long, value_name = "FILE")]
        file: PathBuf,
    },
    /// Print name and scope of every token of a file.
    List {
        /// File of tokens, as in api.tokens.
        #[arg(long, value_name = "FILE")]
        file: PathBuf,
    },
    /// Take a token out of a file. A running service refuses it within a second.
    Revoke {
        /// Name of the token.
        name: String,
        /// File of tokens, as in api.tokens.
        #[arg(long, value_name = "FILE")]
        file: PathBuf,
    },
}

#[derive(Debug, Subcommand)]
enum Store {
    /// Make the index again from the bundles. The service must not run.
    Reindex(ConfigArgs),
}

#[derive(Debug, Args)]
struct Scan {
    #[command(flatten)]
    config: ConfigArgs,
    /// pse, fast, paper or gray.
    #[arg(long)]
    mode: Option<Mode>,
    /// Exposure time in microseconds.
    #[arg(long, value_name = "US", allow_negative_numbers = true)]
    exposure_us: Option<f64>,
    /// Rectangle of the camera image to measure as a plane, as NAME=x,y,width,height. May be repeated.
    #[arg(long, value_name = "NAME=X,Y,W,H")]
    region: Vec<NamedRegion>,
    /// Folder for the result; must be absent or empty.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Debug, Args)]
struct Decode {
    /// Folder with manifest.json and the frames, or the manifest itself.
    bundle: PathBuf,
    /// Calibration to use instead of the bundle's own.
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// The calibration is another tool's stereo result whose left (first) device is the projector.
    #[arg(long)]
    projector_left: bool,
    /// Millimetres per unit of length in another tool's calibration: 1000 for metres.
    #[arg(long, value_name = "MM", default_value_t = 1.0)]
    calibration_unit_mm: f64,
    /// Decode in another mode than the one recorded.
    #[arg(long)]
    mode: Option<Mode>,
    /// Rectangle of the camera image to measure as a plane, as NAME=x,y,width,height. May be repeated.
    #[arg(long, value_name = "NAME=X,Y,W,H")]
    region: Vec<NamedRegion>,
    /// Folder for the result; must be absent or empty.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Debug, Args)]
struct Compare {
    #[command(flatten)]
    config: ConfigArgs,
    /// Recorded capture of ordinary Gray code.
    #[arg(long, value_name = "BUNDLE", conflicts_with = "config")]
    raw: Option<PathBuf>,
    /// Recorded capture for the paper's method; one in mode pse will do as well.
    #[arg(long, value_name = "BUNDLE", conflicts_with = "config")]
    paper: Option<PathBuf>,
    /// Recorded capture in mode pse.
    #[arg(long, value_name = "BUNDLE", conflicts_with = "config")]
    pse: Option<PathBuf>,
    /// Rectangle of the camera image to measure as a plane, as NAME=x,y,width,height. May be repeated.
    #[arg(long, value_name = "NAME=X,Y,W,H")]
    region: Vec<NamedRegion>,
    /// Folder for page and figures; must be absent or empty.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl Compare {
    /// The bundles that were named.
    fn bundles(&self) -> Vec<(Method, PathBuf)> {
        let named = [(Method::Raw, &self.raw), (Method::Paper, &self.paper), (Method::Pse, &self.pse)];
        named.into_iter().filter_map(|(method, path)| Some((method, path.clone()?))).collect()
    }
}

#[derive(Debug, Args)]
struct Patterns {
    #[command(flatten)]
    config: ConfigArgs,
    /// pse, fast, paper or gray.
    #[arg(long)]
    mode: Mode,
    /// Projector size as WIDTHxHEIGHT, each 1 to 8192; the configured projector's where it is left out.
    #[arg(long, value_name = "WxH")]
    size: Option<commands::Size>,
    /// Folder for the images; must be absent or empty.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

fn layers(args: &ConfigArgs, flags: Vec<Override>) -> Layers {
    let mut overrides = Override::from_environment(environment());
    overrides.extend(flags);
    Layers { file: args.config.clone(), overrides }
}

/// The environment, without variables that are not text: none of ours is.
fn environment() -> impl Iterator<Item = (String, String)> {
    std::env::vars_os()
        .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)))
}

/// Runs the program and returns its exit code.
pub fn run() -> u8 {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are no errors; clap prints each to its own stream.
            if !error.use_stderr() {
                let _ = error.print();
                return 0;
            }
            let json = std::env::args_os().any(|argument| argument == "--json");
            commands::print_usage(&error.render().to_string(), json);
            return commands::USAGE;
        }
    };
    start_logging(matches!(cli.command, Command::Serve(_)));
    match dispatch(&cli) {
        Ok(code) => code,
        Err(failure) => {
            commands::print_failure(&failure, cli.json);
            commands::exit_code(&failure)
        }
    }
}

/// Logs go to stderr; POLSCAN_LOG chooses what, as in `POLSCAN_LOG=polscan=debug`. A service says more than a command,
/// and where nobody looks, one object of JSON a line.
fn start_logging(service: bool) {
    let usual = if service { "info" } else { "warn" };
    let filter = tracing_subscriber::EnvFilter::try_from_env("POLSCAN_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(usual));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    match (service, std::io::stderr().is_terminal()) {
        (false, _) => log.without_time().init(),
        (true, true) => log.init(),
        (true, false) => log.json().init(),
    }
}

fn dispatch(cli: &Cli) -> Result<u8, Failure> {
    match &cli.command {
        Command::Scan(args) => {
            let mut flags = Vec::new();
            flags.extend(args.mode.map(|mode| Override::flag("--mode", "scan.mode", mode.name())));
            flags
                .extend(args.exposure_us.map(|us| Override::flag("--exposure-us", "camera.exposure_us", us)));
            let settings = layers(&args.config, flags).load()?;
            commands::scan(&settings, &args.region, &args.out, cli.json)
        }
        Command::Decode(args) => {
            let request = DecodeRequest {
                bundle: &args.bundle,
                calibration: args.calibration.as_deref(),
                projector_left: args.projector_left,
                calibration_unit_mm: args.calibration_unit_mm,
                mode: args.mode,
                regions: &args.region,
            };
            commands::decode(&request, &args.out, cli.json)
        }
        Command::Export(args) => commands::export(args, cli.json),
        Command::Compare(args) => {
            let bundles = args.bundles();
            let what = match bundles.is_empty() {
                true => commands::CompareArgs::Twin {
                    settings: Box::new(layers(&args.config, Vec::new()).load()?),
                    name: args.config.config.as_deref().unwrap_or(Path::new("")).display().to_string(),
                },
                false => commands::CompareArgs::Bundles(bundles),
            };
            commands::compare(&what, &args.region, &args.out, cli.json)
        }
        Command::Calibrate(what) => {
            let load = |file: Option<&Path>| {
                layers(&ConfigArgs { config: file.map(Path::to_path_buf) }, Vec::new()).load()
            };
            commands::calibrate(what, load, cli.json)
        }
        Command::Plan(args) => commands::plan(args, cli.json),
        Command::Verify(args) => {
            let load = |file: Option<&Path>| {
                layers(&ConfigArgs { config: file.map(Path::to_path_buf) }, Vec::new()).load()
            };
            commands::verify(args, load, cli.json)
        }
        Command::Patterns(args) => {
            let settings = layers(&args.config, Vec::new()).load()?;
            commands::patterns(&settings, args.mode, args.size, &args.out, cli.json)
        }
        Command::Serve(args) => {
            let mut flags = Vec::new();
            let listen = args.listen.as_deref();
            flags.extend(listen.map(|listen| Override::flag("--listen", "api.listen", listen)));
            flags.extend(args.store.as_deref().map(|dir| Override::flag("--store", "store.dir", dir)));
            let settings = layers(&args.config, flags).load()?;
            commands::serve(settings, args.address_file.as_deref(), cli.json)
        }
        Command::Token(Token::Add { name, scope, file }) => commands::add_token(file, name, *scope, cli.json),
        Command::Token(Token::List { file }) => commands::list_tokens(file, cli.json),
        Command::Token(Token::Revoke { name, file }) => commands::revoke_token(file, name, cli.json),
        Command::Store(Store::Reindex(args)) => {
            commands::reindex(&layers(args, Vec::new()).load()?, cli.json)
        }
        Command::Openapi => Ok(commands::openapi()),
        Command::Doctor(args) => commands::doctor(&layers(args, Vec::new()).load()?, cli.json),
        Command::Devices(args) => commands::devices(&layers(args, Vec::new()).load()?, cli.json),
        Command::Show(args) => {
            let shown =
                args.picture.parse().map_err(|error: String| Failure::data("choose a picture", error))?;
            commands::show(&layers(&args.config, Vec::new()).load()?, shown, &args.picture, cli.json)
        }
        Command::Projector { listen } => commands::projector(listen.as_deref()),
        Command::CheckConfig { file } => {
            let args = ConfigArgs { config: Some(file.clone()) };
            let settings = layers(&args, Vec::new()).load()?;
            commands::check_config(&settings, file, cli.json)
        }
    }
}
