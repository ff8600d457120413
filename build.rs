//! Sees to it that the page that the program embeds has been built.

use std::path::Path;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    for file in ["index.html", "assets/page.js", "assets/page.css", "assets/cloud.js", "assets/icon.svg"] {
        let path = Path::new("web/dist").join(file);
        println!("cargo::rerun-if-changed={}", path.display());
        if !path.exists() {
            println!(
                "cargo::error=the operator's page is not built ({} is missing); run this first: scripts/install build",
                path.display()
            );
            return;
        }
    }
}
