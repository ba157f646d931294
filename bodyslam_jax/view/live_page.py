"""The page of a running estimate: picture, top and side view, and uncertainties.

What it shows is replaced as a whole after each frame; browsers fetch the newest. Paths
are thinned, so that a page of an hour is as long as one of a minute.
"""

import dataclasses
import functools
import json
import threading
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from bodyslam_jax.body.skeleton import PARENTS
from bodyslam_jax.view.serve import PageHandler, PageServer, local_server
from bodyslam_jax.view.style import POINT

_MAX_PATH_POINTS = 600
"""Points of a path; every second point of a longer one is dropped."""
_MAX_WIDTH_PX = 960
"""Width of the widest picture, px."""
_JPEG_QUALITY = 75
"""The default of libjpeg."""
_BONES = tuple((parent, joint) for joint, parent in enumerate(PARENTS) if joint)
_PERSON_COLORS = ((80, 170, 255), (255, 160, 80), (120, 220, 120), (220, 120, 220))
"""Colours of people by their number, BGR."""


@dataclasses.dataclass
class Path:
    """A growing path that is thinned as it grows."""

    points: list[list[float]] = dataclasses.field(default_factory=list)
    every: int = 1
    count: int = 0

    def add(self, point: np.ndarray) -> None:
        if self.count % self.every == 0:
            self.points.append([round(float(x), 3) for x in point])
            if len(self.points) > _MAX_PATH_POINTS:
                self.points = self.points[::2]
                self.every *= 2
        self.count += 1


class LivePage:
    """What browsers are shown, and the server that shows it."""

    def __init__(self, port: int = 0) -> None:
        """**Raises:** `InputError` if the port is taken."""
        self.picture, self.state = b"", b"{}"
        self.paths: dict[str, Path] = {}
        self.server: PageServer = local_server(functools.partial(_Handler, self), port)
        self.thread = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.thread.start()

    def show(
        self,
        image: UInt8[np.ndarray, "y x 3"],
        points: Float[np.ndarray, "n 2"],
        people: Sequence[
            tuple[int, Float[np.ndarray, "24 2"], Float[np.ndarray, "24 3"]]
        ],
        T_WC: Float[np.ndarray, "4 4"],
        figures: dict[str, Any],
    ) -> None:
        """Shows a frame.

        Args:
            points: tracked points of the scene, px.
            people: number, joints in the image (px) and in the world (m).
            T_WC: the camera.
            figures: numbers and lines beside the picture.
        """
        picture = _drawn(image, points, people)
        ok, encoded = cv2.imencode(
            ".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        )
        self.paths.setdefault("camera", Path()).add(T_WC[:3, 3])
        for person, _, joints in people:
            self.paths.setdefault(str(person), Path()).add(joints[0])
        rounded = lambda x: np.round(np.asarray(x, float), 3).tolist()
        state = {
            "paths": {name: path.points for name, path in self.paths.items()},
            "camera": rounded(T_WC),
            "people": [
                {"person": person, "joints": rounded(joints)}
                for person, _, joints in people
            ],
            "bones": _BONES,
            **figures,
        }
        if ok:
            self.picture = encoded.tobytes()
        self.state = json.dumps(state).encode()

    def close(self) -> None:
        """Ends the server."""
        self.server.shutdown()
        self.server.server_close()


class _Handler(PageHandler):
    def __init__(self, page: LivePage, *args: Any) -> None:
        self.page = page
        super().__init__(*args)

    def answer(self, name: str) -> None:
        if name == "":
            self.send_bytes(_HTML.encode(), ".html")
        elif name == "picture.jpg" and self.page.picture:
            self.send_bytes(self.page.picture, ".jpg")
        elif name == "state.json":
            self.send_bytes(self.page.state, ".json")
        else:
            super().answer(name)


def _drawn(
    image: UInt8[np.ndarray, "y x 3"],
    points: Float[np.ndarray, "n 2"],
    people: Sequence[tuple[int, np.ndarray, np.ndarray]],
) -> UInt8[np.ndarray, "h w 3"]:
    zoom = min(1.0, _MAX_WIDTH_PX / image.shape[1])
    picture = image.copy()
    if zoom < 1:
        size = round(image.shape[1] * zoom), round(image.shape[0] * zoom)
        picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    at = lambda uv: tuple(int(x) for x in np.clip(np.rint(uv * zoom), -9999, 9999))
    for uv in points:
        cv2.circle(picture, at(uv), 1, POINT, -1, cv2.LINE_AA)
    for person, uv, _ in people:
        colour = _PERSON_COLORS[person % len(_PERSON_COLORS)]
        for a, b in _BONES:
            cv2.line(picture, at(uv[a]), at(uv[b]), colour, 3, cv2.LINE_AA)
    return picture


_HTML = """<!doctype html><meta charset="utf-8"><title>bodyslam live</title>
<style>
body{margin:0;background:#161a1e;color:#dde;font:15px/1.4 system-ui,sans-serif}
main{display:flex;flex-wrap:wrap;gap:12px;padding:12px}
img,canvas{background:#0c0f12;border-radius:6px;display:block}
#p{max-width:min(100%,960px)}h1{font-size:15px;margin:12px 12px 0;font-weight:600}
table{border-spacing:12px 2px}td:first-child{color:#9ab}ul{margin:6px 0;color:#fc8}
</style><h1>bodyslam live</h1><main><img id="p" alt="the picture of the camera">
<div><canvas id="t" width="380" height="380"></canvas>
<canvas id="s" width="380" height="180" style="margin-top:12px"></canvas></div>
<div><table id="f"></table><ul id="n"></ul></div></main><script>
const C=["#ffaa50","#50a0ff","#78dc78","#dc78dc"],$=i=>document.getElementById(i);
function view(id,axes,s){const c=$(id),g=c.getContext("2d"),[a,b]=axes;
 g.clearRect(0,0,c.width,c.height);
 let all=Object.values(s.paths).flat();for(const p of s.people)all=all.concat(p.joints);
 if(!all.length)return;const A=all.map(p=>p[a]),B=all.map(p=>p[b]);
 const lo=[Math.min(...A),Math.min(...B)],hi=[Math.max(...A),Math.max(...B)];
 const z=.86*Math.min(c.width/Math.max(hi[0]-lo[0],2),
  c.height/Math.max(hi[1]-lo[1],2));
 const X=p=>c.width/2-z*(p[a]-(lo[0]+hi[0])/2),Y=p=>c.height/2-z*(p[b]-(lo[1]+hi[1])/2);
 const line=(ps,col,w)=>{g.strokeStyle=col;g.lineWidth=w;g.beginPath();
  ps.forEach((p,i)=>i?g.lineTo(X(p),Y(p)):g.moveTo(X(p),Y(p)));g.stroke()};
 for(const[k,ps]of Object.entries(s.paths))
  line(ps,k=="camera"?"#eee":C[k%4],k=="camera"?2:1.5);
 for(const p of s.people)for(const[i,j]of s.bones)
  line([p.joints[i],p.joints[j]],C[p.person%4],2);
 const T=s.camera,e=[T[0][3],T[1][3],T[2][3]],r=28/z,
  q=x=>e.map((v,i)=>v+r*(T[i][2]+x*T[i][0]));line([e,q(-.5),q(.5),e],"#eee",2);
 g.fillStyle="#89a";g.fillText(id=="t"?"from above":"from the side",8,14);
 g.fillText("1 m",8,c.height-12);g.strokeStyle="#89a";g.lineWidth=2;
 g.beginPath();g.moveTo(34,c.height-15);g.lineTo(34+z,c.height-15);g.stroke()}
async function tick(){try{const r=await fetch("state.json");const s=await r.json();
 if(s.paths){$("p").src="picture.jpg?"+Date.now();view("t",[0,2],s);view("s",[2,1],s);
 const f=$("f");f.replaceChildren();for(const[k,v]of Object.entries(s.figures||{})){
  const row=f.insertRow();row.insertCell().textContent=k;row.insertCell().textContent=v}
 const n=$("n");n.replaceChildren();for(const t of s.notes||[]){
  const li=document.createElement("li");li.textContent=t;n.append(li)}}
 }catch(e){document.title="bodyslam live (ended)"}setTimeout(tick,200)}tick()
</script>"""
