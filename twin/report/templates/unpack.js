"use strict";
/* What is packed on the page: gzip in base64. A browser of before 2023 may lack the reader and is told so. */
const unpacked = (async () => {
  const text = (id) => {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  const script = document.createElement("script");
  script.textContent = await text("plotly");
  document.head.appendChild(script);
  return JSON.parse(await text("data"));
})();
unpacked.catch((reason) => {
  document.getElementById("not-unpacked").hidden = false;
  console.error(reason);
});
