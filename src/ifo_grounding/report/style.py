"""How a report's page looks."""

STYLE = """
:root { --paper: #ffffff; --raised: #f6f8fa; --ink: #1f2328; --faint: #59636e; --line: #d8dee4;
  --good: #00795a; --bad: #b84d00; --accent: #0072b2; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #0d1117; --raised: #161b22; --ink: #e6edf3; --faint: #9da7b3; --line: #2d333b;
    --good: #2ec4a0; --bad: #f4843c; --accent: #4ba3e3; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 60rem; margin: 0 auto; padding: 1.5rem 1rem 4rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; padding-bottom: .3rem;
  border-bottom: 1px solid var(--line); }
p { margin: 0 0 .8rem; }
.summary, .note, .detail, .name { color: var(--faint); }
.note { font-size: .92rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(10.5rem, 1fr)); gap: .7rem;
  margin-top: 1.2rem; }
.card { background: var(--raised); border: 1px solid var(--line); border-radius: 10px;
  padding: .8rem 1rem; }
.card .name { font-size: .88rem; }
.card .number { font-size: 1.45rem; font-weight: 650; line-height: 1.3; white-space: nowrap;
  font-variant-numeric: tabular-nums; }
.card .detail { font-size: .8rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; min-width: 50%; }
th, td { text-align: left; padding: .4rem 1.2rem .4rem 0; border-bottom: 1px solid var(--line);
  vertical-align: baseline; }
th { font-size: .85rem; color: var(--faint); font-weight: 600; }
td.figure { white-space: nowrap; }
td .detail { font-size: .82rem; }
@media (max-width: 40rem) {
  th, td { padding-right: .7rem; }
  td.figure { white-space: normal; }
  td .detail { display: block; } }
img { max-width: 100%; height: auto; display: block; }
.plot img, img.frames { border-radius: 10px; border: 1px solid var(--line); max-width: none; }
img.frames { background: #fff; }
@media (min-width: 60rem) { .plot img, img.frames { max-width: 100%; } }
.cases { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: .9rem; }
figure { margin: 0; }
figure img { width: 100%; image-rendering: pixelated; border: 4px solid var(--good);
  border-radius: 6px; }
figure.bad img { border-color: var(--bad); }
figcaption { font-size: .88rem; line-height: 1.35; margin-top: .35rem; }
.good strong { color: var(--good); } .bad strong { color: var(--bad); }
"""
