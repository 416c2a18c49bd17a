// One self-contained HTML file: script and style are put into the page, so that it also opens from an e-mail.
import { readFileSync } from "node:fs";
import { defineConfig } from "vite";

// The licences of what is built in ask that their notices go along.
const { dependencies } = JSON.parse(readFileSync("package.json", "utf8"));
const notices = Object.entries(dependencies).map(([name, version]) => `${name} ${version}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim()}`);

const inline = {
  name: "inline",
  enforce: "post",
  generateBundle(_, bundle) {
    const page = Object.values(bundle).find((f) => f.fileName.endsWith(".html"));
    let html = page.source;
    for (const [name, file] of Object.entries(bundle)) {
      if (name.endsWith(".js")) {
        const code = file.code.replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--");
        html = html.replace(/<script type="module"[^>]*src="[^"]*"[^>]*><\/script>/, () => `<script type="module">${code}</script>`);
        delete bundle[name];
      } else if (name.endsWith(".css")) {
        html = html.replace(/<link rel="stylesheet"[^>]*>/, () => `<style>${file.source}</style>`);
        delete bundle[name];
      }
    }
    page.source = html.replace("<html", () => `<!--\n${notices.join("\n\n").replaceAll("--", "- -")}\n-->\n<html`);
  },
};

export default defineConfig({
  base: "./",
  build: {
    outDir: "../src/relit/viewer/static",
    emptyOutDir: true,
    assetsInlineLimit: 1e8,
    modulePreload: false,
    chunkSizeWarningLimit: 2000,
    rollupOptions: { output: { codeSplitting: false } },
  },
  plugins: [inline],
});
