import { defineConfig } from "vite";

// Names are fixed, since the program embeds these files by name; the service has browsers ask whether they changed.
export default defineConfig({
  build: {
    target: "es2022",
    assetsInlineLimit: 0,
    cssCodeSplit: false,
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 1000,
    rollupOptions: {
      output: {
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
