"""What custom resources may hold, as far as we write them.

Facts of KubeRay 1.7.0 (`ray-operator/config/crd/bases`) and of the Prometheus operator
(`ServiceMonitor`, `PodMonitor`): names of fields and their types. Pod templates and the like are
those of Kubernetes itself. A field that is not here is a mistake, or is to be added. With KubeRay's
own definitions at hand, test_deploy.py holds this against them.
"""

from typing import Any

Schema = dict[str, Any]

KUBERAY_VERSION = "1.7.0"
CORE = "https://kubernetes.io/api/_definitions.json#/$defs/io.k8s.api.core.v1."
META = "https://kubernetes.io/api/_definitions.json#/$defs/io.k8s.apimachinery.pkg.apis.meta.v1."

TEXT: Schema = {"type": "string"}
FLAG: Schema = {"type": "boolean"}
NUMBER: Schema = {"type": "number"}
WHOLE: Schema = {"type": "integer", "minimum": 0}
TEXTS: Schema = {"type": "object", "additionalProperties": TEXT}


def core(name: str) -> Schema:
    return {"$ref": CORE + name}


def one_of(*values: str) -> Schema:
    return {"type": "string", "enum": list(values)}


def many(of: Schema) -> Schema:
    return {"type": "array", "items": of}


def fields(*required: str, **properties: Schema) -> Schema:
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


def resource(api: str, kind: str, spec: Schema) -> Schema:
    return fields(
        *("apiVersion", "kind", "metadata", "spec"),
        apiVersion=one_of(api),
        kind=one_of(kind),
        metadata={"$ref": META + "ObjectMeta"},
        spec=spec,
    )


AUTOSCALER = fields(
    version=one_of("v1", "v2"),
    idleTimeoutSeconds=WHOLE,
    upscalingMode=one_of("Default", "Aggressive", "Conservative"),
    image=TEXT,
    imagePullPolicy=TEXT,
    resources=core("ResourceRequirements"),
    securityContext=core("SecurityContext"),
    env=many(core("EnvVar")),
    envFrom=many(core("EnvFromSource")),
    volumeMounts=many(core("VolumeMount")),
    command=many(TEXT),
    args=many(TEXT),
)
HEAD = fields(
    "template",
    template=core("PodTemplateSpec"),
    rayStartParams=TEXTS,
    serviceType=TEXT,
    headService=core("Service"),
    enableIngress=FLAG,
    resources=TEXTS,
    labels=TEXTS,
)
WORKERS = fields(
    *("groupName", "minReplicas", "maxReplicas", "template"),
    groupName=TEXT,
    replicas=WHOLE,
    minReplicas=WHOLE,
    maxReplicas=WHOLE,
    numOfHosts=WHOLE,
    idleTimeoutSeconds=WHOLE,
    priority={"type": "integer"},
    suspend=FLAG,
    rayStartParams=TEXTS,
    resources=TEXTS,
    labels=TEXTS,
    template=core("PodTemplateSpec"),
)
RAY_CLUSTER = fields(
    "headGroupSpec",
    rayVersion=TEXT,
    authOptions=fields(mode=one_of("disabled", "token"), secretName=TEXT, enableK8sTokenAuth=FLAG),
    enableInTreeAutoscaling=FLAG,
    autoscalerOptions=AUTOSCALER,
    headServiceAnnotations=TEXTS,
    suspend=FLAG,
    managedBy=TEXT,
    headGroupSpec=HEAD,
    workerGroupSpecs=many(WORKERS),
)
RAY_JOB = fields(
    entrypoint=TEXT,
    entrypointNumCpus=NUMBER,
    entrypointNumGpus=NUMBER,
    entrypointResources=TEXT,
    runtimeEnvYAML=TEXT,
    jobId=TEXT,
    metadata=TEXTS,
    submissionMode=TEXT,
    submitterConfig=fields(backoffLimit=WHOLE),
    submitterPodTemplate=core("PodTemplateSpec"),
    clusterSelector=TEXTS,
    rayClusterSpec=RAY_CLUSTER,
    backoffLimit=WHOLE,
    activeDeadlineSeconds=WHOLE,
    preRunningDeadlineSeconds=WHOLE,
    shutdownAfterJobFinishes=FLAG,
    ttlSecondsAfterFinished=WHOLE,
    suspend=FLAG,
    managedBy=TEXT,
)
ENDPOINT: dict[str, Schema] = {
    "port": TEXT,
    "path": TEXT,
    "interval": {"type": "string", "pattern": "^[0-9]+(ms|s|m)$"},
    "scheme": one_of("http", "https"),
    "authorization": fields(type=TEXT, credentials=core("SecretKeySelector")),
}
SELECTOR: Schema = {"$ref": META + "LabelSelector"}

SCHEMAS = {
    "RayCluster": resource("ray.io/v1", "RayCluster", RAY_CLUSTER),
    "RayJob": resource("ray.io/v1", "RayJob", RAY_JOB),
    "ServiceMonitor": resource(
        "monitoring.coreos.com/v1",
        "ServiceMonitor",
        fields("endpoints", "selector", selector=SELECTOR, endpoints=many(fields(**ENDPOINT))),
    ),
    "PodMonitor": resource(
        "monitoring.coreos.com/v1",
        "PodMonitor",
        fields("selector", selector=SELECTOR, podMetricsEndpoints=many(fields(**ENDPOINT))),
    ),
}
