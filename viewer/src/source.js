// Where the page's data comes from: the local server, or what `relit export --format html` put into the file.
export async function manifest() {
  const embedded = document.getElementById("relit-manifest").textContent.trim();
  if (embedded) return JSON.parse(embedded);
  const answer = await fetch("manifest.json", { cache: "no-store" });
  if (!answer.ok) throw new Error(`the server does not answer (${answer.status})`);
  return answer.json();
}

export async function bytesOf(url) {
  if (url.startsWith("data:")) {
    const text = atob(url.slice(url.indexOf(",") + 1)), out = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
    return out.buffer;
  }
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url}: ${answer.status}`);
  return answer.arrayBuffer();
}
