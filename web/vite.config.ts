import { readFileSync } from "node:fs";
import { defineConfig } from "vite";

// What is passed on with the program keeps its licence.
const licence = readFileSync(new URL("node_modules/three/LICENSE", import.meta.url), "utf8");

// Names are fixed, since the program embeds these files by name; the service has browsers ask whether they changed.
export default defineConfig({
  esbuild: { legalComments: "inline" },
  build: {
    target: "es2022",
    assetsInlineLimit: 0,
    cssCodeSplit: false,
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 1000,
    rollupOptions: {
      output: {
        banner: (chunk) => (chunk.name === "cloud" ? `/*! three.js\n${licence}*/` : ""),
        entryFileNames: "assets/page.js",
        chunkFileNames: "assets/[name].js",
        assetFileNames: "assets/page[extname]",
      },
    },
  },
  // For work on the page: `npx vite` serves it from disk beside a service that runs already.
  server: {
    host: "127.0.0.1",
    proxy: Object.fromEntries(
      ["/v1", "/readyz", "/livez", "/docs", "/openapi.json"].map((path) => [
        path,
        { target: process.env.POLSCAN_URL ?? "http://127.0.0.1:7777", changeOrigin: true },
      ]),
    ),
  },
});
